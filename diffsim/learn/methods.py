"""The methods by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from diffsim.core.check import require_choice
from diffsim.core.checked import checked
from diffsim.learn.gradient import GradientLearner, GradientOptions
from diffsim.learn.mixed import MixedLearner, MixedOptions
from diffsim.learn.run import Learner
from diffsim.learn.sapo import SapoLearner, SapoOptions
from diffsim.learn.setup import Setup
from diffsim.learn.shac import ShacLearner, ShacOptions

Options = Mapping[str, Any]
METHODS = ("gradient", "shac", "sapo", "mixed", "ppo", "sac", "tqc", "cma")


@checked
def make_learner(method: str, setup: Setup, options: Options) -> Learner:
    """A method ready to train.

    Args:
        method: One of ``METHODS``.
        setup: Task and seed.
        options: Fields of the method's options that differ from their defaults.
    """
    require_choice("method", method, METHODS)
    if method == "gradient":
        return GradientLearner(setup, GradientOptions(**options))
    if method == "shac":
        return ShacLearner(setup, ShacOptions(**options))
    if method == "sapo":
        return SapoLearner(setup, SapoOptions(**options))
    if method == "mixed":
        return MixedLearner(setup, MixedOptions(**options))
    # what follows needs packages of the extra "rl"
    if method == "cma":
        from diffsim.learn.cma_es import CmaLearner, CmaOptions

        return CmaLearner(setup, CmaOptions(**options))
    if method == "sac":
        from diffsim.learn.sac import SacLearner, SacOptions

        return SacLearner(setup, SacOptions(**options))
    if method == "tqc":
        from diffsim.learn.tqc import TqcLearner, TqcOptions

        return TqcLearner(setup, TqcOptions(**options))
    from diffsim.learn.ppo import PpoLearner, PpoOptions

    return PpoLearner(setup, PpoOptions(**options))
