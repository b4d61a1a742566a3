"""What a simulator from outside was commanded before its runs: zero, or its first commands."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Run, Study
from diffsim.systems.description import Quantity
from diffsim.systems.outside.before_runs import STOOD
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


def setup_with(simulator, study: Study):
    return outside_setup(study, simulator, {"gain": Quantity(value=1.0, percent=20)}, held=True)


def delay_of(setup):
    (delay,) = [e for e in setup.effects if e.name == "delay"]
    return delay


def late_job(setup, run: Run, late: float):
    """What the simulator is asked under a delay [s] of the force."""
    size = {delay_of(setup): torch.tensor([late], dtype=torch.float64)}
    return setup.model.scene(run, setup.model.at_prior(), size).job()


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
    setup = setup_with(simulator, study)
    assert setup.model.before_runs is not None
    for run in study.runs:
        assert setup.model.before_runs.zero(run) == zero
    first = 0.0 if zero else study.runs[0].command["force"][0]
    heard = late_job(setup, study.runs[0], 0.03).run.command["force"]
    np.testing.assert_allclose(heard[:3], first, atol=1e-9)


def test_a_saved_model_keeps_what_had_stood():
    """New runs tell nothing of it; a model that was saved without it takes first values."""
    study = recorded(3, None, seed=1)
    tests = tuple(replace(run, use="test", name=f"{run.name}_new") for run in study.runs)
    for before, stood in ((None, ["force"]), (0.0, [])):
        frame = setup_with(carriage, recorded(3, before, seed=1)).model.frame
        assert frame[STOOD] == stood
        older = {key: kept for key, kept in frame.items() if key != STOOD}
        for kept, zero in ((frame, {"force"} - {*stood}), (older, set())):
            model = setup_with(carriage, replace(study, runs=tests, frame=kept)).model
            assert [model.before_runs.zero(run) for run in tests] == [zero, zero]
            assert model.frame[STOOD] == sorted({"force"} - zero)


@pytest.mark.parametrize("before", [None, 0.0])
def test_first_values_had_stood_where_no_noise_is_stated(before):
    """Nothing is clear then, whatever the record says; and no simulation is spent on it."""
    study = recorded(3, before, seed=1)
    study = replace(study, channels=tuple(replace(c, sd=None) for c in study.channels))
    model = setup_with(carriage, study).model
    assert [model.before_runs.zero(run) for run in study.runs] == [set(), set()]
    assert model.simulations.count == 0


def test_a_simulator_that_refuses_invented_commands_keeps_its_causes():
    """A command that jumps from zero is refused: what was recorded is late behind its first."""

    def careful(parameters, run):
        if np.abs(np.diff(run.command["force"])).max() > 3.5:
            raise RuntimeError("the force jumps")
        return carriage(parameters, run)

    study = recorded(3, 0.0, seed=1)
    setup = setup_with(careful, study)
    heard = late_job(setup, study.runs[0], 0.03).run.command["force"]
    np.testing.assert_allclose(heard[:3], study.runs[0].command["force"][0], atol=1e-9)
    size = {delay_of(setup): torch.tensor([0.03], dtype=torch.float64)}
    found = setup.model.predict(study.runs[0], setup.model.at_prior(), size)
    assert found.isfinite().all()


def test_a_simulator_that_has_whole_runs_alone_keeps_first_values():
    def whole(parameters, run):
        return np.resize(carriage(parameters, run), (len(TIME), 1))

    study = recorded(3, 0.0, seed=1)
    heard = late_job(setup_with(whole, study), study.runs[0], 0.03).run.command["force"]
    np.testing.assert_allclose(heard[:3], study.runs[0].command["force"][0], atol=1e-9)


def test_a_simulator_that_takes_delays_alone_has_them_behind_first_values():
    """Between samples, too; and no simulation is spent on what it cannot be told."""

    def late(parameters, run, delays):
        return carriage(parameters, run)

    study = recorded(3, 0.0, seed=1)
    setup = setup_with(late, study)
    job = late_job(setup, study.runs[0], 0.013)
    assert (job.delays, job.before) == ({"force": 0.013}, {})
    np.testing.assert_array_equal(job.run.command["force"], study.runs[0].command["force"])
    assert setup.model.simulations.count == 0
