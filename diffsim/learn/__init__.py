"""Training of controllers: through the simulator's gradient, and without it.

A learner takes a ``Setup`` (task and seed) and its frozen options; ``Run`` keeps its progress on
disk and goes on after an interruption. ``rl/compare.py`` trains several methods on equal terms.

Needs the packages of the extra ``rl``. Importing this room needs nothing; what is
missing is named when a learner is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffsim.core.lazy import offered

if TYPE_CHECKING:
    from diffsim.learn import open_loop
    from diffsim.learn.cma_es import CmaLearner, CmaOptions
    from diffsim.learn.gradient import GradientLearner, GradientOptions
    from diffsim.learn.kept_files import trained_names
    from diffsim.learn.methods import METHODS, make_learner
    from diffsim.learn.mixed import MixedLearner, MixedOptions
    from diffsim.learn.ppo import PpoLearner, PpoOptions
    from diffsim.learn.recipes import RECIPES, Recipe, recipe
    from diffsim.learn.run import Learner, Run, read_rows, train
    from diffsim.learn.sac import SacLearner, SacOptions
    from diffsim.learn.sapo import SapoLearner, SapoOptions
    from diffsim.learn.setup import Setup
    from diffsim.learn.shac import ShacLearner, ShacOptions
    from diffsim.learn.tqc import TqcLearner, TqcOptions
    from diffsim.learn.trained import Trained, load_trained, read_trained

_OFFERED = {
    "cma_es": ("CmaLearner", "CmaOptions"),
    "gradient": ("GradientLearner", "GradientOptions"),
    "kept_files": ("trained_names",),
    "methods": ("METHODS", "make_learner"),
    "mixed": ("MixedLearner", "MixedOptions"),
    "open_loop": ("open_loop",),
    "ppo": ("PpoLearner", "PpoOptions"),
    "recipes": ("RECIPES", "Recipe", "recipe"),
    "run": ("Learner", "Run", "read_rows", "train"),
    "sac": ("SacLearner", "SacOptions"),
    "sapo": ("SapoLearner", "SapoOptions"),
    "setup": ("Setup",),
    "shac": ("ShacLearner", "ShacOptions"),
    "tqc": ("TqcLearner", "TqcOptions"),
    "trained": ("Trained", "load_trained", "read_trained"),
}
if not TYPE_CHECKING:  # to a type checker, any name would be one
    __getattr__, __dir__ = offered(
        __name__, {n: f"{__name__}.{m}" for m, names in _OFFERED.items() for n in names}
    )

__all__ = [
    "METHODS",
    "RECIPES",
    "CmaLearner",
    "CmaOptions",
    "GradientLearner",
    "GradientOptions",
    "Learner",
    "MixedLearner",
    "MixedOptions",
    "PpoLearner",
    "PpoOptions",
    "Recipe",
    "Run",
    "SacLearner",
    "SacOptions",
    "SapoLearner",
    "SapoOptions",
    "Setup",
    "ShacLearner",
    "ShacOptions",
    "TqcLearner",
    "TqcOptions",
    "Trained",
    "load_trained",
    "make_learner",
    "open_loop",
    "read_rows",
    "read_trained",
    "recipe",
    "train",
    "trained_names",
]
