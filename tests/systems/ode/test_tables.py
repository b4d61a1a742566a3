"""A table of all causes: each as if no other were known, and no dearer for them."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.data.study import Channel, Command, Run, Study
from diffsim.identify import Problem, WhiteNoise
from diffsim.systems.registry import setup_of

TIME = 0.02 * np.arange(60.0)
NAMES = ("u", "v")


def wide_problem():
    """Two masses, each with a command of its own, and all causes of the library."""
    rng = np.random.default_rng(0)
    channels = tuple(Channel(f"x_{n}", "m", "position", sd=1e-3) for n in NAMES)
    goals = {n: np.repeat(rng.uniform(-1.0, 1.0, 6), 10) for n in NAMES}
    model = {
        "system": "ode",
        "inputs": [{"name": n, "held": True} for n in NAMES],
        "parameters": {f"d_{n}": {"value": 2.0, "percent": 20} for n in NAMES},
        "states": {f"{what}_{n}": 0.0 for n in NAMES for what in ("place", "speed")},
        "define": {f"pull_{n}": f"{n} - d_{n}*speed_{n} - 9*place_{n}" for n in NAMES},
        "rates": {
            **{f"place_{n}": f"speed_{n}" for n in NAMES},
            **{f"speed_{n}": f"pull_{n}" for n in NAMES},
        },
        "readings": {f"x_{n}": f"place_{n}" for n in NAMES},
    }
    run = Run("a", TIME, np.zeros((len(TIME), 2)), goals, "a")
    commands = tuple(Command(n, unit="N") for n in NAMES)
    setup = setup_of(Study("masses", "ode", channels, (run,), commands=commands, model=model))
    return Problem(setup.model, (run,), WhiteNoise(channels), tuple(setup.effects))


def test_slopes_of_a_cause_are_those_without_the_others():
    """A cause of one command keeps its slopes beside the one that does the same to all of them."""
    wide = wide_problem()
    x = np.zeros(len(wide.names))
    _, slopes = wide.linearize_record(x, screen=True)
    several = 0
    for effect in wide.effects:
        alone = replace(wide, effects=(effect,))
        own = alone.columns_of(effect)
        _, expected = alone.linearize_record(x[: own[-1] + 1], screen=True, only=own)
        found = slopes[:, wide.columns_of(effect)]
        # lanes of a batch round alike to the last digits, which differences divide by their step
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-9), effect.name
        several += effect.name.startswith(("slow_share", "acceleration_limit"))
    assert several > 2


def test_each_cause_is_applied_where_it_acts():
    """Rows of a table grow with its points, not with points by causes."""
    wide, rows = wide_problem(), []

    def counting(effect):
        def apply(scene, size, run):
            rows.append(size.reshape(-1, size.shape[-1]).shape[0])
            return effect.apply(scene, size, run)

        return replace(effect, apply=apply)

    counted = replace(wide, effects=tuple(counting(e) for e in wide.effects))
    counted.linearize_record(np.zeros(len(wide.names)), screen=True)
    assert 0 < sum(rows) <= 2 * len(wide.owners)
