"""Runs of formulas are cut where two starts part, and nowhere else."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose import diagnose
from diffsim.systems.ode import pieces
from diffsim.systems.registry import setup_of
from tests.systems.standing_rod import GAIN, RATE, rod_study
from tests.systems.turning_lever import TRUE, lever_study


@lru_cache
def wild():
    return setup_of(lever_study(seed=0))


def test_constants_of_a_lever_that_turns_over_are_inside_their_intervals():
    study, setup = lever_study(seed=0), wild()
    report = diagnose(
        study, setup.model, setup.effects, seed=0, unknowns=setup.unknowns, settings=setup.settings
    )
    friction = next(c for c in report.causes if c.name == "dry_friction_at_axis")
    assert friction.status == "certain"
    assert friction.size["size"].low < TRUE["friction"] < friction.size["size"].high
    for row in report.base:
        if row.name in TRUE:
            assert row.low <= TRUE[row.name] <= row.high, row
    gate = next(g for g in report.gates if g.name == "start_states")
    assert gate.value == sum(map(len, setup.model.cuts.values()))
    assert any("two starts 0.15 apart in speed" in text for text in report.sentences)


def test_a_lever_that_swings_is_not_cut():
    study = lever_study(wild=False, seed=0)
    model = setup_of(study).model
    assert not model.cuts
    assert not any("_from_" in p.name for p in model.base)


def test_a_model_that_runs_away_says_nothing_of_usual_motion_from_there_on():
    """Starts are moved by a share of it: a lever that turns over 100 times is none of the rig's."""
    swings = np.sin(np.linspace(0.0, 30.0, 300))[:, None]
    turns = swings + np.maximum(np.arange(300.0)[:, None] - 150.0, 0.0)
    gone = pieces._count_near(turns, np.where(swings > 0.9, np.nan, swings))
    assert turns[gone - 1, 0] < pieces.AWAY_SPANS * 2.0
    assert 150 < gone < 160
    assert pieces._count_near(swings, 0.2 * swings) == 300
    assert pieces._count_near(turns + 1e3, swings) == pieces.MIN_PIECE_SAMPLES


def test_cuts_of_a_run_are_its_own():
    """Neither other runs nor their use decide where a run is cut: a test run tells nothing."""
    study, cuts = lever_study(seed=0), wild().model.cuts
    assert cuts
    run = next(r for r in study.runs if r.name in cuts)
    alone = setup_of(lever_study(seed=0, only=run.name)).model.cuts
    assert alone == {run.name: cuts[run.name]}


def test_a_piece_begins_where_its_start_says():
    study, model = lever_study(seed=0), wild().model
    run = next(r for r in study.fit_runs if r.name in model.cuts)
    time, _ = model.cuts[run.name][0]
    at = int(np.searchsorted(run.time_s, time))
    moved = next(i for i, p in enumerate(model.base) if p.name.startswith("angle_from_"))
    q = model.at_prior()
    before = model.predict(run, q)
    q[moved] += 1.0
    after = model.predict(run, q)
    sd = model.base[moved].sd
    assert torch.equal(after[:at], before[:at])
    assert float(after[at, 0] - before[at, 0]) == pytest.approx(sd, rel=1e-9)
    # the plain model at its prior follows the record for a while from there
    near = slice(at, at + 8)
    assert np.abs(before[near, 0].numpy() - run.measured[near, 0]).max() < 0.1


def test_pieces_that_begin_where_the_one_before_ends_change_nothing():
    study, model = lever_study(seed=0), wild().model
    run = next(r for r in study.fit_runs if r.name in model.cuts)
    scene = model.scene(run, model.at_prior())
    whole = replace(scene, restarts=())
    path = dict(zip(scene.begin()[0], whole.solved()[1].unbind(-1), strict=True))
    places = np.searchsorted(scene.grid.times.numpy(), [t for t, _ in scene.restarts])
    going_on = tuple(
        (float(scene.grid.times[i]), {s: path[s][i] for s in path}) for i in places.tolist()
    )
    cut = replace(scene, restarts=going_on)
    torch.testing.assert_close(cut.simulate(), whole.simulate(), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("motion", ["fall**2*sin(angle)", "fall**2*angle"])
def test_no_piece_of_an_unstable_motion_is_long(motion):
    """At its end paths may have had no time to bend; those of a linear one never do."""
    cuts = setup_of(rod_study(motion)).model.cuts
    assert set(cuts) == {"a", "b", "c"}
    for pieces_of in cuts.values():
        times = np.array([0.0, *(time for time, _ in pieces_of), 3.0])
        assert np.diff(times).max() * RATE < 5.0  # one of 9.3 held a fit 6,000 nats too high


@pytest.mark.parametrize("motion", ["0", "-fall**2*angle"])
def test_a_motion_that_drifts_or_swings_is_not_cut(motion):
    """Starts part by drifts as well, but never faster than time goes on."""
    assert not setup_of(rod_study(motion)).model.cuts


def test_warmth_that_comes_through_a_wall_is_not_cut():
    """It grows at the far side by any factor, from nothing: this was taken for unstable."""
    n, time = 7, 0.05 * np.arange(400.0)
    beside = {i: f"x{max(i - 1, 0)} - 2*x{i} + x{min(i + 1, n - 1)}" for i in range(n)}
    description = {
        "system": "ode",
        "states": {f"x{i}": "0" for i in range(n)},
        "inputs": [{"name": "heat", "held": True}],
        "parameters": {"rate": {"value": 0.02, "percent": 10, "unit": "1/s"}},
        "rates": {f"x{i}": f"rate*({beside[i]})" + " + heat" * (i == 0) for i in range(n)},
        "readings": {"far": f"x{n - 1}"},
        "effects": {"only": ["command_gain"]},
    }
    measured = 1e-5 * (time / 20.0)[:, None] ** 7
    runs = [
        Run("ab"[k], time, measured, {"heat": np.ones(400)}, "ab"[k], k, "fit") for k in range(2)
    ]
    channels = (Channel("far", "K", "temperature", 1e-8),)
    assert not setup_of(Study("wall", "ode", channels, tuple(runs), model=description)).model.cuts


def test_the_gain_of_a_rod_that_balances_is_found():
    study = rod_study("fall**2*sin(angle)")
    setup = setup_of(study)
    report = diagnose(
        study, setup.model, setup.effects, seed=0, unknowns=setup.unknowns, settings=setup.settings
    )
    assert report.null.ended == "converged"
    assert report.named == ("command_gain",)
    gain = next(c for c in report.causes if c.name == "command_gain").size["size"]
    assert gain.low < GAIN - 1.0 < gain.high
