"""gymnasium, asked for before any module of this room imports it."""

from typing import Any

from diffsim.core.optional import optional

gymnasium: Any = optional("gymnasium", purpose="diffsim.envs")
