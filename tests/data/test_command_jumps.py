"""Commands have noise, too: jumps that nothing commanded are told by `check`."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.data.command_jumps import jumps_of
from diffsim.data.record.shapes import find_jumps
from diffsim.data.record.signals import Record
from diffsim.data.study import Channel, Command, Run, Study
from diffsim.data.study_check import check_study

TIME = 0.01 * np.arange(500)
SWAY = 3e-3 * np.sin(4.0 * TIME) * np.exp(-TIME)
NOISE = 2e-5 * np.random.default_rng(1).normal(size=500)


def found(values, *, is_measured=True):
    jumps = jumps_of(np.asarray(values, dtype=np.float64), is_measured=is_measured)
    return jumps.back, jumps.lasting


def test_a_marker_that_is_lost_for_a_sample_or_two_is_found():
    sway = SWAY + NOISE
    sway[[60, 200, 201]] += [9e-4, -6e-4, -6e-4]
    assert found(sway) == ([60, 200, 201], [])
    assert found(sway, is_measured=False) == ([60, 200, 201], [])
    assert jumps_of(sway, is_measured=True).size == pytest.approx(9e-4, rel=0.2)
    sway[150] = np.nan  # samples that are unknown move no index
    assert found(sway) == ([60, 200, 201], [])


def test_a_marker_that_is_taken_for_another_stays_off():
    sway = SWAY + NOISE
    sway[260:] += 8e-4
    assert found(sway) == ([], [260])
    assert found(sway, is_measured=False) == ([], [])  # what is commanded may step


def test_over_a_gap_of_lost_samples_it_may_have_moved():
    kept = np.r_[0:200, 240:500]  # 0.4 s were lost
    values = 5.0 * TIME[kept] + NOISE[kept]
    assert jumps_of(values, is_measured=True, times=TIME[kept]).lasting == []
    assert jumps_of(values, is_measured=True).lasting == [200]


@pytest.mark.parametrize(
    "values",
    [
        SWAY,
        SWAY + NOISE,
        NOISE,
        np.sin(60.0 * TIME),
        np.where(TIME % 1.0 < 0.5, 1.0, -1.0),
        (TIME % 0.09) * 5.0,
        np.clip(TIME - 2.0, 0.0, 1.0) + 1e-3 * NOISE,
        np.where((TIME > 1.0) & (TIME < 1.015), 1.0, 0.0),
        np.random.default_rng(2).choice([-1.0, 1.0], 500),
        np.random.default_rng(3).normal(size=500),
        np.ones(500),
        np.arange(4.0),
    ],
)
def test_what_is_commanded_and_moves_has_none(values):
    assert found(values) == ([], [])


def test_check_says_which_command_of_which_run_jumps_by_how_much():
    sway = SWAY + NOISE
    sway[60] += 9e-4
    channel = Channel("tip_m", "m", "position", sd=1e-4)
    run = Run("load", TIME, (2.0 * SWAY)[:, None], {"support": sway}, "load", 0, "fit")
    command = Command("support", "m", is_measured=True, shown_unit="mm")
    study = Study("beam", "soft_body", (channel,), (run,), commands=(command,))
    said = [p for p in check_study(study) if "jumps" in p.message]
    assert [(p.severity, p.where) for p in said] == [("warning", "run load")]
    assert "command support jumps off and back at 1 sample, by up to 0.8" in said[0].message
    assert "mm, first at 0.6 s" in said[0].message
    still = replace(study, runs=(replace(run, command={"support": SWAY + NOISE}),))
    assert not [p for p in check_study(still) if "jumps" in p.message]


def test_what_jumps_in_many_runs_is_one_sentence():
    """A log of a copter had 21 lines, one for each run, motor and kind of jump."""
    rng, runs = np.random.default_rng(6), []
    at = np.arange(len(TIME))
    for k, name in enumerate(("first", "second", "third")):
        course = {f"u{i}": SWAY + 1e-4 * rng.normal(size=len(TIME)) for i in range(3)}
        course["u1"] += np.where(at == 60 + k, 0.05, 0.0)
        course["u2"] += np.where(at > 90 + k, 0.08, 0.0)
        tip = SWAY + 1e-4 * rng.normal(size=len(TIME))
        runs.append(Run(name, TIME, tip[:, None], course, name, k, "fit"))
    commands = tuple(Command(f"u{i}", "-", is_measured=True) for i in range(3))
    channel = Channel("tip", "m", "position", sd=1e-4)
    study = Study("copter", "soft_body", (channel,), tuple(runs), commands=commands)
    (found,) = find_jumps(Record.of(study))
    assert (found.where, found.stops) == ("study", False)
    assert found.says.startswith(
        "commands u1, u2 jump off and back at 3 samples and jump and stay at 3 samples of 3 runs, "
        "by up to 0.08"
    )
    assert found.says.endswith("first at 0.6 s of run first")


def test_check_tells_samples_that_a_sensor_misread():
    position = np.where(TIME < 2.0, 0.0, np.sin(TIME - 2.0))  # it stands still, and then moves
    position[[50, 301]] = -3.14159
    run = Run("drop", TIME, position[:, None], {}, "drop", 0, "fit")
    channel = Channel("position", "rad", "angle", sd=0.003, shown_unit="mrad")
    study = Study("servo", "ode", (channel,), (run,))
    told = [p for p in check_study(study) if p.rule]
    assert [(p.severity, p.rule) for p in told] == [("warning", "codes")]
    assert "-3.14159 in 2 samples" in told[0].message
    assert "`decode: {missing: -3.14159}`" in told[0].message
    clean = replace(run, measured=np.where(position == -3.14159, 0.0, position)[:, None] * 0.0)
    quiet = replace(study, runs=(clean,))
    assert not [p for p in check_study(quiet) if p.rule]
