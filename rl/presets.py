"""What ``rl/compare.py`` runs: tasks, budgets and the options that the search may choose from.

Every method may try as many candidates, one run each on a seed that no compared run uses. Runs
without gradients may take more steps, as their steps are cheaper and they need more.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from diffsim.core.check import require_choice
from diffsim.learn.methods import Options
from diffsim.learn.recipes import recipe
from diffsim.learn.setup import Setup
from rl.trainings import Plan

_Candidates = dict[str, tuple[dict[str, Any], ...]]
_COPTER: _Candidates = {
    "gradient": (
        {"batch": 16, "horizon": 50, "learning_rate": 3e-3},
        {"batch": 16, "horizon": 50, "learning_rate": 1e-2},
        {"batch": 16, "horizon": 100, "learning_rate": 1e-2},
    ),
    "shac": (
        {"batch": 64, "window": 16, "actor_rate": 1e-2},
        {"batch": 64, "window": 32, "actor_rate": 3e-3},
        {"batch": 64, "window": 32, "actor_rate": 1e-2},
    ),
    # with what the search has chosen for the short-horizon actor-critic
    "sapo": (
        {"batch": 64, "window": 32, "actor_rate": 1e-2, "temperature": 0.1},
        {"batch": 64, "window": 32, "actor_rate": 1e-2, "temperature": 0.01},
        {"batch": 64, "window": 32, "actor_rate": 1e-2, "temperature": 1.0},
    ),
    "mixed": (
        {"batch": 16, "horizon": 50, "learning_rate": 1e-2},
        {"batch": 4, "learning_rate": 1e-2},
        {"batch": 4, "learning_rate": 1e-2, "cut_every": 50},
    ),
    "ppo": (
        {"envs": 16, "rollout": 128, "learning_rate": 3e-4},
        {"envs": 16, "rollout": 128, "learning_rate": 1e-3},
        {"envs": 16, "rollout": 64, "learning_rate": 1e-3, "exploration": 0.3},
    ),
    "sac": (
        {"passes": 32, "learning_rate": 1e-3},
        {"passes": 32, "learning_rate": 3e-3},
        {"passes": 64, "learning_rate": 1e-3},
    ),
}
# measured by benchmarks.envs on the coarse bodies, as is the copter's 1.9
_SWIM_COST = 2.1
_SWIM_QUALITY = {"horizons": (5, 10, 25, 50, 100), "episodes": 2, "directions": 32}
_STARFISH: _Candidates = {
    "gradient": (
        {"batch": 1, "learning_rate": 1e-2},
        {"batch": 2, "learning_rate": 1e-2},
        {"batch": 2, "learning_rate": 1e-2, "horizon": 100},
        {"batch": 2, "learning_rate": 1e-2, "horizon": 50},
        {"batch": 4, "learning_rate": 1e-2, "horizon": 50},
    ),
    "shac": (
        {"batch": 4, "window": 16, "actor_rate": 1e-2},
        {"batch": 4, "window": 32, "actor_rate": 1e-2},
        {"batch": 8, "window": 16, "actor_rate": 1e-2},
        {"batch": 8, "window": 32, "actor_rate": 1e-2},
        {"batch": 8, "window": 32, "actor_rate": 3e-3},
    ),
    "sapo": (
        {"batch": 4, "window": 32, "actor_rate": 1e-2, "temperature": 0.1},
        {"batch": 4, "window": 32, "actor_rate": 1e-2, "temperature": 0.01},
        {"batch": 4, "window": 32, "actor_rate": 1e-2, "temperature": 1.0},
        {"batch": 4, "window": 16, "actor_rate": 1e-2, "temperature": 0.1},
        {"batch": 8, "window": 16, "actor_rate": 1e-2, "temperature": 0.1},
    ),
    "mixed": (
        {"batch": 2, "learning_rate": 1e-2},
        {"batch": 2, "learning_rate": 1e-2, "horizon": 100},
        {"batch": 2, "learning_rate": 1e-2, "horizon": 50},
        {"batch": 4, "learning_rate": 1e-2, "horizon": 50},
        {"batch": 4, "learning_rate": 1e-2, "horizon": 50, "spread": 0.3},
    ),
    "ppo": (
        {"rollout": 64, "learning_rate": 1e-3},
        {"rollout": 128, "learning_rate": 1e-3, "exploration": 1.0},
        {"rollout": 64, "learning_rate": 1e-3, "hold_noise": 8},
        {"rollout": 64, "learning_rate": 3e-3, "exploration": 1.0},
        {"rollout": 64, "learning_rate": 3e-3, "exploration": 2.0, "hold_noise": 8},
    ),
    "cma": (
        {"kind": "sinusoid", "spread": 0.5},
        {"kind": "sinusoid", "spread": 0.3},
        {"kind": "sinusoid", "spread": 1.0},
        {"kind": "sinusoid", "spread": 0.5, "population": 12},
        {"kind": "knots", "spread": 0.5},
    ),
}
# of what the starfish's search has shown to be best; short episodes leave the shark where it starts
_SHARK: _Candidates = {
    "gradient": (
        {"batch": 1, "learning_rate": 1e-2},
        {"batch": 1, "learning_rate": 3e-2},
        {"batch": 2, "learning_rate": 3e-2},
    ),
    "shac": _STARFISH["shac"][1:4],
    # a window of a second may be shorter than what finding a stroke takes, so a longer one too
    "sapo": (
        {"batch": 4, "window": 32, "actor_rate": 1e-2, "temperature": 0.1},
        {"batch": 4, "window": 32, "actor_rate": 1e-2, "temperature": 1.0},
        {"batch": 4, "window": 100, "actor_rate": 1e-2, "temperature": 0.1},
    ),
    "mixed": (
        {"batch": 2, "learning_rate": 3e-2},
        {"batch": 2, "learning_rate": 3e-2, "spread": 0.3},
        {"batch": 4, "learning_rate": 3e-2, "spread": 0.3},
    ),
    "ppo": (
        {"rollout": 128, "learning_rate": 1e-3, "exploration": 1.0},
        {"rollout": 64, "learning_rate": 3e-3, "exploration": 1.0},
        {"rollout": 64, "learning_rate": 3e-3, "exploration": 2.0, "hold_noise": 8},
    ),
    "cma": _STARFISH["cma"][:3],
}


def _copter(task: str, scale: float) -> Plan:
    steps = {"gradient": 24_000, "shac": 96_000, "sapo": 96_000, "mixed": 24_000}
    tuning = {"gradient": 24_000, "shac": 48_000, "sapo": 48_000, "mixed": 24_000}
    steps |= {"ppo": 80_000, "sac": 24_000}
    tuning |= {"ppo": 64_000, "sac": 12_000}
    return Plan(Setup(task, step_cost=1.9), _times(scale, steps), _times(scale, tuning), _COPTER)


def _swim(
    task: str,
    candidates: _Candidates,
    *,
    coarse: bool,
    steps: int,
    ppo_steps: int,
    quality: Options = _SWIM_QUALITY,
) -> Plan:
    options = {"robot": {"coarse": coarse}}
    setup = Setup(task, options, evaluation_episodes=2, step_cost=_SWIM_COST)
    budget = dict.fromkeys(("gradient", "mixed"), steps)
    tuning = dict.fromkeys(("gradient", "mixed", "shac", "sapo"), steps)
    budget |= dict.fromkeys(("shac", "sapo"), 2 * steps)
    budget |= dict.fromkeys(("ppo", "cma"), ppo_steps)
    tuning |= dict.fromkeys(("ppo", "cma"), ppo_steps // 4)
    budget, tuning = ({m: b[m] for m in candidates} for b in (budget, tuning))
    return Plan(setup, budget, tuning, candidates, ratings=6, quality=quality)


def _times(scale: float, steps: dict[str, int]) -> dict[str, int]:
    return {method: int(count * scale) for method, count in steps.items()}


def _quick() -> dict[str, Plan]:
    setup = Setup("CopterHover", {"seconds": 0.4}, evaluation_episodes=4, warm_up=10)
    candidates: _Candidates = {
        "gradient": ({"batch": 4}, {"batch": 4, "learning_rate": 1e-2}),
        "shac": ({"batch": 4, "window": 8}, {"batch": 4, "window": 4}),
        "sapo": ({"batch": 4, "window": 8}, {"batch": 4, "window": 4}),
        "mixed": ({"batch": 4}, {"batch": 4, "learning_rate": 1e-2}),
        "ppo": (
            {"envs": 4, "rollout": 32, "minibatch": 64},
            {"envs": 8, "rollout": 16, "minibatch": 64},
        ),
        "sac": ({"passes": 2, "first": 128}, {"passes": 4, "first": 128}),
        "cma": ({"population": 4}, {"population": 8}),
    }
    steps = dict.fromkeys(candidates, 640) | {"ppo": 1280}
    plan = Plan(setup, steps, _times(0.5, steps), candidates, seeds=(0, 1), ratings=4)
    return {"CopterHover": plan}


def _coarse() -> dict[str, Plan]:
    return {
        "CopterHover": _copter("CopterHover", 1.0),
        "CopterTrack": _copter("CopterTrack", 1.0),
        "StarfishSwim": _swim(
            "StarfishSwim", _STARFISH, coarse=True, steps=2_400, ppo_steps=28_672
        ),
        "SharkSwim": _swim("SharkSwim", _SHARK, coarse=True, steps=4_800, ppo_steps=28_672),
    }


def _thesis() -> dict[str, Plan]:
    """7,020 and 10,017 degrees of freedom; 40,000 steps with gradients, 800,000 without, a run."""
    return {
        "CopterHover": _copter("CopterHover", 8.0),
        "CopterTrack": _copter("CopterTrack", 8.0),
        "StarfishSwim": _swim(
            "StarfishSwim", _STARFISH, coarse=False, steps=40_000, ppo_steps=800_000
        ),
        "SharkSwim": _swim("SharkSwim", _SHARK, coarse=False, steps=40_000, ppo_steps=800_000),
    }


def _thesis_short() -> dict[str, Plan]:
    """The thesis's bodies, on about the coarse preset's budgets (PPO: 16,384 steps).

    The two best candidates of each method's search on the coarse body are tried again.
    """
    starfish: _Candidates = {
        "gradient": (_STARFISH["gradient"][3], _STARFISH["gradient"][0]),
        "ppo": (_STARFISH["ppo"][4], _STARFISH["ppo"][3]),
    }
    shark: _Candidates = {
        "gradient": (_SHARK["gradient"][2], _SHARK["gradient"][0]),
        "mixed": (_SHARK["mixed"][1], _SHARK["mixed"][2]),
        "ppo": (_SHARK["ppo"][1], _SHARK["ppo"][2]),
        "cma": (_SHARK["cma"][2], _SHARK["cma"][1]),
    }
    few = {"horizons": (10, 25, 50, 100), "episodes": 1, "directions": 16}
    return {
        "StarfishSwim": _swim(
            "StarfishSwim", starfish, coarse=False, steps=2_400, ppo_steps=16_384, quality=few
        ),
        "SharkSwim": _swim(
            "SharkSwim", shark, coarse=False, steps=4_800, ppo_steps=16_384, quality=few
        ),
    }


# by recipe: the clock and the first network of the swimmers' recipe, for every method. The gradient
# has nothing to choose; three candidates of each rival, of what earlier searches have shown to be
# best and of what a first network that already strokes may need (less exploration)
_RIVALS: _Candidates = {
    "ppo": (
        {"rollout": 64, "learning_rate": 3e-3, "exploration": 0.5},
        {"rollout": 64, "learning_rate": 1e-3, "exploration": 1.0},
        {"rollout": 64, "learning_rate": 3e-3, "exploration": 2.0, "hold_noise": 8},
    ),
    "sac": (
        {"passes": 64, "learning_rate": 1e-3},
        {"passes": 64, "learning_rate": 3e-3},
        {"passes": 128, "learning_rate": 1e-3, "discount": 0.95},
    ),
    "tqc": (
        {"passes": 64, "learning_rate": 1e-3},
        {"passes": 64, "learning_rate": 3e-3},
        {"passes": 128, "learning_rate": 1e-3, "discount": 0.95},
    ),
}


def _by_recipe(*, coarse: bool, steps: int, seeds: tuple[int, ...]) -> dict[str, Plan]:
    """Both swimmers by their recipe against rivals that start from the same network."""
    return {task: _swim_by_recipe(task, coarse, steps, seeds) for task in _SWIMMERS}


_SWIMMERS = ("SharkSwim", "StarfishSwim")


def _swim_by_recipe(task: str, coarse: bool, steps: int, seeds: tuple[int, ...]) -> Plan:
    mine = recipe(task)
    setup = dataclasses.replace(
        mine.setup_of(task, task_options={"robot": {"coarse": coarse}}), step_cost=_SWIM_COST
    )
    candidates = {"gradient": (dict(mine.gradient),), **_RIVALS}
    budget = {"gradient": setup.steps} | dict.fromkeys(_RIVALS, steps)
    tuning = {"gradient": setup.steps} | dict.fromkeys(_RIVALS, steps // 2)
    few = _SWIM_QUALITY if coarse else {"horizons": (10, 50, 100), "episodes": 1, "directions": 16}
    return Plan(setup, budget, tuning, candidates, seeds=seeds, ratings=6, quality=few)


# by the copters' recipe. Three candidates of each rival: what the search of ``coarse`` took, and
# two beside it; for PPO with as many episodes side by side as the recipe has
_COPTER_RIVALS: _Candidates = {
    "shac": (
        {"batch": 64, "window": 32, "actor_rate": 1e-2},
        {"batch": 64, "window": 16, "actor_rate": 1e-2},
        {"batch": 64, "window": 32, "actor_rate": 2e-2},
    ),
    "sapo": (
        {"batch": 64, "window": 32, "actor_rate": 1e-2, "temperature": 0.1},
        {"batch": 64, "window": 16, "actor_rate": 1e-2, "temperature": 0.1},
        {"batch": 64, "window": 32, "actor_rate": 2e-2, "temperature": 0.1},
    ),
    "ppo": (
        {"envs": 16, "rollout": 128, "learning_rate": 1e-3},
        {"envs": 64, "rollout": 32, "learning_rate": 1e-3},
        {"envs": 64, "rollout": 64, "learning_rate": 1e-3, "exploration": 0.3},
    ),
}


def _copter_by_recipe(task: str) -> Plan:
    """Rivals have twice the steps of the recipe, and half of them for each candidate."""
    mine = recipe(task)
    setup = dataclasses.replace(mine.setup_of(task), step_cost=1.9)
    candidates = {"gradient": (dict(mine.gradient),), **_COPTER_RIVALS}
    budget = {"gradient": setup.steps} | dict.fromkeys(_COPTER_RIVALS, 2 * setup.steps)
    tuning = {"gradient": setup.steps} | dict.fromkeys(_COPTER_RIVALS, setup.steps)
    return Plan(setup, budget, tuning, candidates, ratings=10)


PRESETS: dict[str, Callable[[], dict[str, Plan]]] = {
    "quick": _quick,
    "coarse": _coarse,
    "thesis_short": _thesis_short,
    "thesis": _thesis,
    "recipe": lambda: _by_recipe(coarse=True, steps=14_336, seeds=(0, 1, 2, 3, 4)),
    "copter_recipe": lambda: {t: _copter_by_recipe(t) for t in ("CopterHover", "CopterTrack")},
    "thesis_recipe": lambda: _by_recipe(coarse=False, steps=14_336, seeds=(0, 1, 2, 3, 4)),
}


def preset(name: str) -> dict[str, Plan]:
    """Plans by task."""
    return PRESETS[require_choice("preset", name, PRESETS)]()
