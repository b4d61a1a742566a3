"""Gates on data: a good study passes, and each defect is named."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.data import Channel, Command, Study, check_study
from diffsim.data.study_check import Problem, merge_alike
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


def test_gap_in_the_clock():
    t = make_study().runs[1].time_s.copy()
    t[7:] += 0.1
    assert "run b: 1 gaps in the clock, the first after 0.2 s" in problems(
        with_run(make_study(), 1, time_s=t), "warning"
    )


def test_unit_against_name():
    wrong = Channel("tip_z_mm", "m", "position", 1e-6)
    study = replace(make_study(), channels=(wrong, *make_study().channels[1:]))
    found = problems(study, "error")
    assert "channel tip_z_mm: the name ends in 'mm', but unit is 'm'" in found


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
    run = study.runs[1]
    swing = np.sin(2.0 * np.pi * t)[:, None] * np.ones(run.measured.shape[1]) * 1e4 * sd
    noise = rng.normal(size=(2, *swing.shape)) * sd
    calm = replace(run, name="a", time_s=t, measured=swing + noise[0], command={}, columns={})
    shaken = replace(calm, name="b", measured=swing + times * noise[1])
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
        ({"measured": np.full((25, 2), np.nan)}, "nothing was measured"),
        ({"measured": np.ones((25, 2))}, "never changes"),
        ({"command": {}}, "different command columns"),
        ({"command": {"tendon_N": np.full(25, np.nan)}}, "is unknown in 100%"),
        ({"order": 0}, "share a place in the order"),
    ],
)
def test_defects_of_a_run(changes, message):
    found = problems(with_run(make_study(), 1, **changes))
    assert message in found


def test_errors_come_first():
    t = make_study().runs[2].time_s.copy()
    t[7:] += 0.1
    bad = with_run(with_run(make_study(), 2, time_s=t), 3, use="fit")
    found = check_study(replace(bad, model={"system": "ode", "states": "TODO"}))
    assert [p.severity for p in found] == ["error", "warning", "warning"]


TIMES = make_study().runs[0].time_s
SPOILED = {
    "time_s of two dimensions": ({"time_s": TIMES[:, None]}, "time_s must have shape"),
    "no stamp": ({"time_s": np.where(TIMES > 0.5, np.nan, TIMES)}, "time_s of run 'b' must be fin"),
    "an infinite stamp": ({"time_s": np.append(TIMES[:-1], np.inf)}, "got inf at sample 24"),
    "time runs back": ({"time_s": TIMES[::-1]}, "increase, got 0.766667 at sample 1"),
    "time in words": ({"time_s": TIMES.astype(str)}, "time_s must be an array of real numbers"),
    "complex time": ({"time_s": 1j * TIMES}, "time_s must be .*, got complex128"),
    "one sample less": ({"measured": np.zeros((24, 2))}, r"measured must have shape \(25, num_ch"),
    "a row for a table": ({"measured": np.zeros(25)}, "measured must have shape"),
    "samples in words": ({"measured": np.full((25, 2), "1")}, "measured must be an array of real"),
    "a list": ({"measured": [[0.0, 0.0]] * 25}, "measured must be an array"),
    "a short command": ({"command": {"u": np.zeros(3)}}, r"command\['u'\] must have shape \(25,\)"),
    "a command in words": ({"command": {"u": "0.1"}}, r"command\['u'\] must be .*, got str"),
    "a column of tensors": ({"columns": {"temp": [0.0] * 25}}, r"columns\['temp'\] must be"),
    "raw of another length": ({"raw": {"tip": ("tip", TIMES[1:])}}, r"raw\['tip'\] must have"),
    "no group": ({"group": None}, "group must be text"),
}


@pytest.mark.parametrize(("changes", "said"), SPOILED.values(), ids=SPOILED)
def test_a_run_made_by_hand_is_refused_by_the_name_of_what_is_wrong(changes, said):
    with pytest.raises((TypeError, ValueError), match=said):
        replace(make_study().runs[1], **changes)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"channels": (Channel("x", "m", "position"),)}, "measured of run 'a' must have a column"),
        ({"channels": (Channel("x", "m", "position"),) * 2}, "channels must have different names"),
        ({"runs": (make_study().runs[0],) * 2}, "runs must have different names, got 'a' more"),
        ({"runs": ("a.csv",)}, r"runs\[0\] must be a Run, got str"),
        ({"commands": ("tendon_N",)}, r"commands\[0\] must be a Command, got str"),
    ],
)
def test_a_study_made_by_hand_is_refused_by_the_name_of_what_is_wrong(changes, said):
    with pytest.raises((TypeError, ValueError), match=said):
        replace(make_study(), **changes)


def test_equal_stamps_are_of_no_study():
    run = replace(make_study().runs[1], time_s=np.maximum(TIMES, 0.1))
    with pytest.raises(ValueError, match=r"time_s of run 'b' must increase, got 0\.1 twice"):
        replace(make_study(), runs=(run,))


def test_what_runs_or_channels_share_is_one_line():
    said = [
        Problem("error", "channel load_0", "column load[0] touches 0 18 times"),
        Problem("error", "channel load_1", "column load[1] touches 0 4 times"),
        Problem("note", "run a", "channel x is misread at 1 sample, at 2.5 s"),
        Problem("note", "run b", "channel x is misread at 3 samples, at 0.5 s"),
        Problem("note", "run b", "channel y is misread at 3 samples, at 0.5 s"),
    ]
    assert list(merge_alike(said)) == [
        "error: channel load_0: column load[0] touches 0 18 times (likewise load_1)",
        "note: run a: channel x is misread at 1 sample, at 2.5 s (likewise b)",
        "note: run b: channel y is misread at 3 samples, at 0.5 s",
    ]
