"""The one door to the compiled core: checks, allocates outputs, passes addresses."""

from __future__ import annotations

from diffsim._core import core

INSTRUCTION_SET: str = core.instruction_set
