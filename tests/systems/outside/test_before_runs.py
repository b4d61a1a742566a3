"""What a simulator from outside was commanded before its runs: zero, or its first commands."""

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Run, Study
from diffsim.systems.description import Quantity
from diffsim.systems.outside.setup import outside_setup

TIME, PARTS = 0.01 * np.arange(150), 20


def carriage(parameters, run, tilt=0.0):
    """A carriage of 2 kg under a force that is held from sample to sample."""
    x, v, seen = 0.0, 0.0, []
    for push in run.command["force"]:
        for part in range(PARTS):
            if part == 0:
                seen.append(x)
            v += 0.01 / PARTS * (parameters["gain"] * push - 3.0 * v + tilt) / 2.0
            x += 0.01 / PARTS * v
    return np.array(seen)[:, None]


def slope(parameters, run):
    """The same on a slope: without a force it does not rest."""
    return carriage(parameters, run, tilt=1.0)


def recorded(late: int, before: float | None, seed: int) -> Study:
    """Two runs whose force comes so many samples late; None: first ones had long been heard."""
    rng, runs = np.random.default_rng(seed), []
    for name, first in (("up", 4.0), ("down", -3.0)):
        force = np.where(TIME < 0.08, first, 1.5) + 0.5 * np.sin(20.0 * TIME)
        earlier = np.full(late, force[0] if before is None else before)
        heard = np.concatenate([earlier, force[: len(TIME) - late]])
        blank = np.zeros((len(TIME), 1))
        clean = carriage({"gain": 1.1}, Run(name, TIME, blank, {"force": heard}, name))
        seen = clean + rng.normal(0.0, 1e-4, clean.shape)
        runs.append(Run(name, TIME, seen, {"force": force}, name))
    return Study("rail", "outside", (Channel("x", "m", "position", sd=1e-4),), tuple(runs))


@pytest.mark.parametrize(
    ("simulator", "late", "before", "zero"),
    [
        (carriage, 3, 0.0, {"force"}),
        (carriage, 3, None, set()),
        (carriage, 0, 0.0, {"force"}),  # nothing tells: it rests without a force
        (slope, 3, 0.0, set()),
    ],
)
def test_a_run_that_rests_without_commands_began_with_them(simulator, late, before, zero):
    """Unless the record moves at once, and later commands come late."""
    study = recorded(late, before, seed=1)
    setup = outside_setup(study, simulator, {"gain": Quantity(value=1.0, percent=20)}, held=True)
    assert setup.model.before_runs is not None
    for run in study.runs:
        assert setup.model.before_runs.zero(run) == zero
    (delay,) = [e for e in setup.effects if e.name == "delay"]
    size = {delay: torch.tensor([0.03], dtype=torch.float64)}
    heard = setup.model.scene(study.runs[0], setup.model.at_prior(), size).job().run
    first = 0.0 if zero else study.runs[0].command["force"][0]
    np.testing.assert_allclose(heard.command["force"][:3], first, atol=1e-9)
