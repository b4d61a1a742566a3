"""The methods by name."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from diffsim.core.check import require_choice
from diffsim.core.checked import checked
from diffsim.learn.run import Learner
from diffsim.learn.setup import Setup

Options = Mapping[str, Any]
_MODULES = {  # whole names, which scripts/changed_tests.py follows
    "gradient": "diffsim.learn.gradient",
    "shac": "diffsim.learn.shac",
    "sapo": "diffsim.learn.sapo",
    "mixed": "diffsim.learn.mixed",
    "ppo": "diffsim.learn.ppo",
    "sac": "diffsim.learn.sac",
    "tqc": "diffsim.learn.tqc",
    "cma": "diffsim.learn.cma_es",
}
METHODS = tuple(_MODULES)


@checked
def make_learner(method: str, setup: Setup, options: Options) -> Learner:
    """A method ready to train.

    Args:
        method: One of ``METHODS``.
        setup: Task and seed.
        options: Fields of the method's options that differ from their defaults.
    """
    require_choice("method", method, METHODS)
    # only its own: those that need packages of the extra "rl" keep them from the others
    module = import_module(_MODULES[method])
    name = method.capitalize()
    return getattr(module, f"{name}Learner")(setup, getattr(module, f"{name}Options")(**options))
