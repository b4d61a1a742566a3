"""Gates on data: a good study passes, and each defect is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from diffsim.data import Channel, Command, Study, check_study
from tests.data.test_study_file import make_study


def problems(study: Study, severity: str | None = None) -> str:
    return "\n".join(str(p) for p in check_study(study) if severity in (None, p.severity))


def with_run(study: Study, idx: int, **changes) -> Study:
    runs = list(study.runs)
    runs[idx] = replace(runs[idx], **changes)
    return replace(study, runs=tuple(runs))


def test_a_good_study_has_no_problems():
    assert check_study(make_study()) == []


def test_two_commands_are_needed():
    study = make_study()
    assert "all fit runs have one command" in problems(with_run(study, 2, use="test"), "warning")


@pytest.mark.parametrize(
    ("labels", "model", "is_said"),
    [
        ("AABA", None, True),
        ("AABA", {"parameters": {"stiffness": {"value": 1.0, "per": "specimen"}}}, False),
        ("AAAA", None, False),  # all are one
        ("ABCD", None, False),  # a name of each run
        ((1.0, 1.0, 2.0, 2.0), None, False),  # a number, on which a law may depend
    ],
)
def test_labels_that_no_number_of_the_model_may_differ_by_are_told(labels, model, is_said):
    study = replace(make_study(), model=model)
    for idx, label in enumerate(labels):
        study = with_run(study, idx, setup={"specimen": label})
    said = "no number of the model may differ by specimen (A, B): if these are other objects or"
    assert (said in problems(study, "warning")) == is_said


def test_without_a_test_run_nothing_shows_what_the_answer_is_worth():
    assert "no run with use: test" in problems(with_run(make_study(), 3, use="fit"), "warning")


def test_without_a_fit_run_nothing_can_be_fitted():
    runs = tuple(replace(run, use="test") for run in make_study().runs)
    assert "no run with use: fit" in problems(replace(make_study(), runs=runs), "error")


def test_a_held_out_repeat_is_a_warning():
    assert "repeats a fitted command" in problems(
        with_run(make_study(), 3, group="down", command=make_study().runs[2].command), "warning"
    )


def test_clock_that_steps_back():
    t = make_study().runs[1].time_s.copy()
    t[7] = t[5]
    assert "run b: time_s does not increase at sample 7" in problems(
        with_run(make_study(), 1, time_s=t), "error"
    )


def test_gap_in_the_clock():
    t = make_study().runs[1].time_s.copy()
    t[7:] += 0.1
    assert "run b: 1 gaps in the clock, the first after 0.2 s" in problems(
        with_run(make_study(), 1, time_s=t), "warning"
    )


def test_unit_against_name():
    study = replace(make_study(), channels=(Channel("tip_z_mm", "m", "position", 1e-6),) * 2)
    found = problems(study, "error")
    assert "channel tip_z_mm: the name ends in 'mm', but unit is 'm'" in found
    assert "the name is used twice" in found


def test_unknown_noise():
    study = make_study()
    assert "noise unknown" not in problems(study)  # a and b are repeats
    alone = with_run(study, 1, group="other")
    found = problems(alone, "error")
    assert "channel rate_rad_s: noise unknown" in found
    assert "channel tip_z_m" not in found  # its sd is given


@pytest.mark.parametrize(("times", "is_said"), [(1.0, False), (10.0, True)])
def test_a_run_that_scatters_more_than_its_sd_says(times, is_said):
    """A geared motor shook in one of three runs: its speed hid every cause."""
    study, rng = make_study(), np.random.default_rng(0)
    sd = study.channels[0].sd
    t = 0.01 * np.arange(300.0)
    run = replace(study.runs[1], time_s=t, command={}, columns={})
    swing = np.sin(2.0 * np.pi * t)[:, None] * np.ones(run.measured.shape[1]) * 1e4 * sd
    noise = rng.normal(size=(2, *swing.shape)) * sd
    calm = replace(run, name="a", measured=swing + noise[0])
    shaken = replace(run, measured=swing + times * noise[1])
    found = problems(replace(study, runs=(calm, shaken, replace(calm, name="c"))), "note")
    assert ("from sample to sample run b scatters" in found) == is_said


def test_repeats_with_another_command():
    moved = {"tendon_N": make_study().runs[1].command["tendon_N"] + 0.1}
    found = problems(with_run(make_study(), 1, command=moved), "warning")
    assert "group up: its runs did not execute one command: tendon_N differ, most" in found
    assert "run b from that of run a, by 12.5% rms of its range" in found


def test_repeats_under_a_controller():
    moved = {"tendon_N": make_study().runs[1].command["tendon_N"] + 0.1}
    study = with_run(make_study(), 1, command=moved)
    assert check_study(replace(study, commands=(Command("tendon_N", is_measured=True),))) == []


def test_what_is_still_to_be_stated():
    model = {"system": "ode", "masses": [{"name": "cart", "mass": "TODO kg"}]}
    found = problems(replace(make_study(), model=model, todo=("weigh the cart",)))
    assert "warning: study: still to be stated: weigh the cart" in found
    assert "error: model.masses[0].mass: is still to be filled in: TODO kg" in found


def test_unknown_noise_is_guessed_in_the_unit_of_the_files():
    noise = 1e-4 * np.random.default_rng(0).normal(size=(25, 1))
    runs = tuple(replace(r, measured=noise, group=r.name) for r in make_study().runs)
    channels = (Channel("x", "m", "position", shown_unit="mm"),)
    found = problems(replace(make_study(), runs=runs, channels=channels), "error")
    guess = float(found.split("scatters by ")[1].split(" mm")[0])
    assert guess == pytest.approx(0.1, rel=0.3)


def test_many_samples_cost_time():
    runs = tuple(
        replace(r, time_s=np.arange(40_000.0), measured=np.zeros((40_000, 2)), command={})
        for r in make_study().runs
    )
    found = problems(replace(make_study(), runs=runs), "warning")
    assert "240000 samples to be simulated, run a alone has 40000" in found


def test_repeats_on_another_clock_are_compared_in_time():
    run = make_study().runs[1]
    t = np.linspace(run.time_s[0], run.time_s[-1], 40)
    measured = np.random.default_rng(1).normal(size=(40, 2))
    study = with_run(make_study(), 1, time_s=t, measured=measured, command={"tendon_N": t})
    assert check_study(study) == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"measured": np.zeros((25, 3))}, "measured must have shape .* (25, 2), got (25, 3)"),
        ({"measured": np.full((25, 2), np.nan)}, "nothing was measured"),
        ({"measured": np.ones((25, 2))}, "never changes"),
        ({"command": {}}, "different command columns"),
        ({"command": {"tendon_N": np.full(25, np.nan)}}, "is unknown in 100%"),
        (
            {"command": {"tendon_N": np.zeros(3)}},
            "command tendon_N must have shape (25,), got (3,)",
        ),
        ({"name": "a"}, "the name is used twice"),
        ({"order": 0}, "share a place in the order"),
    ],
)
def test_defects_of_a_run(changes, message):
    found = problems(with_run(make_study(), 1, **changes))
    assert all(part in found for part in message.split(" .* "))


def test_errors_come_first():
    t = make_study().runs[2].time_s.copy()
    t[7:] += 0.1
    bad = with_run(with_run(make_study(), 2, time_s=t), 3, use="fit")
    found = check_study(with_run(bad, 1, name="a"))
    assert [p.severity for p in found] == ["error", "warning", "warning"]
