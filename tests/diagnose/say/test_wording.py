"""Sentences of an answer: causes and checks in words, whatever their names in the code."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from diffsim.data.shown import resolution_words
from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose.checks.gates import GateResult
from diffsim.diagnose.judge.records import CauseRow, Interval
from diffsim.diagnose.say.tables import cannot_see
from diffsim.diagnose.say.wording import Answer, sentences
from tests.diagnose.linear import line

SIZE = Interval(0.3, 0.1, 0.5)


def cause(name: str, status: str, size=None, **more) -> CauseRow:
    words = name.replace("_", " ")
    return CauseRow(name, words, "effect", status, 0.9, size or {"size": SIZE}, "N", **more)


def answer(verdict: str, causes, rivals=(), gates=()) -> Answer:
    names = tuple(row.name for row in causes)
    return Answer(
        verdict,
        SimpleNamespace(best=frozenset({0}), share=1.0, lead=0.0, forms={}),
        tuple(causes),
        rivals,
        tuple(gates),
        SimpleNamespace(scatter_ratio=np.ones(1)),
        named=names[:1],
        best_names=names[:1],
    )


def said(*args, **more) -> str:
    return " ".join(sentences(answer(*args, **more), None, []))


def test_causes_and_their_rivals_are_words():
    causes = [cause("rate_limit", "likely"), cause("dry_friction", "cannot be told from")]
    text = said("ambiguous", causes, rivals=(("dry_friction",), ("unknown force",)))
    assert text.startswith(
        "The data ask for rate limit (0.1 to 0.5 N; 90 % interval), "
        "but cannot tell it from dry friction or unknown force."
    )
    assert "_" not in text


def test_many_sizes_are_counted_not_listed():
    sizes = {f"[fan={k}]": Interval(0.1 * k, 0.0, 1.0) for k in range(1, 8)}
    text = said("named", [cause("low_end_loss", "certain", sizes)])
    assert text.startswith("The model lacks low end loss (0.1 to 0.7 N in 7 sizes).")


def test_a_size_for_all_and_departures_are_told_as_what_each_group_has():
    """Each is uncertain, for they share what they say: "all -0.04 to 0.15, left -0.09 to 0.1"."""
    sizes = {
        "all": Interval(0.5, -1.0, 2.0),
        "[servo=a]": Interval(-0.1, -1.5, 1.5),
        "[servo=b]": Interval(0.1, -1.5, 1.5),
    }
    text = said("named", [cause("friction", "certain", sizes)])
    assert text.startswith("The model lacks friction (servo a 0.4, servo b 0.6 N).")


def test_what_is_only_likely_does_not_pass_for_certain():
    """Three likely causes stood beside a certain one in "the model lacks"."""
    names = ("square_drag", "slack")
    causes = [
        cause(name, status) for name, status in zip(names, ("certain", "likely"), strict=True)
    ]
    text = " ".join(sentences(replace(answer("named", causes), named=names), None, []))
    size = "(0.1 to 0.5 N; 90 % interval)"
    assert text.startswith(f"The model lacks square drag {size}, and probably slack {size}.")
    left = [causes[1], cause("coupling", "cannot be told from")]  # of a torque that came late
    named = replace(answer("named", left), named=("slack", "coupling"))
    text = " ".join(sentences(named, None, []))
    assert text.startswith(f"The model probably lacks slack {size}, and perhaps coupling {size}.")


def test_several_that_help_are_a_plural():
    causes = [cause(name, "likely", helps=True) for name in ("lag", "drag")]
    assert "help, but are not named" in said("unknown", causes)
    assert "helps, but is not named" in said("unknown", causes[:1])


def test_a_check_that_failed_is_said_in_words_with_three_digits():
    gate = GateResult(
        name="gradient:sliding_friction", passed=False, value=0.395931, limit=1e-4, note="1 run"
    )
    text = said("named", [cause("lag", "certain")], gates=[gate])
    failed = "A check failed: the derivative by sliding friction could not be confirmed: two ways"
    assert f"{failed} to compute it differ by 40 %." in text
    finer = GateResult("time_step", False, 3.14159, 2.0, "what refining moves")
    text = said("named", [cause("lag", "certain")], gates=[finer])
    moved = "a finer time step moves records and fit by 3.14 standard deviations in all"
    assert f"A check failed: {moved}, 2 at most were wanted." in text


def test_a_size_without_a_unit_has_no_dash():
    effect = replace(line("loss", typical=0.2), unit="-")
    screened = SimpleNamespace(smallest_visible=[76.6])
    assert cannot_see([effect], screened, {}) == {"loss": "below 76.6 (383 times a usual size)"}


def test_a_delay_stands_beside_what_the_record_can_show():
    encoder = 0.005 * np.round(np.sin(np.arange(200) / 9.0) / 0.005)
    run = Run("a", np.arange(200) / 30.0, encoder[:, None], {}, "a")
    study = Study("rig", "ode", (Channel("angle", "rad", "angle", sd=1e-3),), (run,))
    assert resolution_words(study) == (
        "One row of the record is 33.3 ms, one step of angle 0.005 rad."
    )
    slow = replace(study, runs=(replace(run, time_s=150.0 * run.time_s),))
    assert resolution_words(slow).startswith("One row of the record is 5 s, ")
    some = replace(study, runs=(replace(slow.runs[0], row_s=0.01),))  # of a record of 10 ms
    assert resolution_words(some).startswith("One row of the record is 10 ms, ")


def test_drives_that_are_off_by_one_factor_are_one_sentence():
    sheets = [
        replace(
            cause(f"actuator.m{k}.kp", "likely", {"": Interval(2.9 * kp, 2.7 * kp, 4.1 * kp)}),
            words=f"kp of m{k}", unit="-", origin="data sheet",
            note=f"data sheet: {kp:g} +- 2 (sd)",
        )
        for k, kp in ((1, 12.0), (2, 20.0))
    ]  # fmt: skip
    drives = tuple(row.name for row in sheets)
    text = " ".join(sentences(replace(answer("named", sheets), drives=drives), None, []))
    assert "Kp of m1 and kp of m2 are all 2.9 (2.7 to 4.1) times their data sheets." in text
    assert "the data sheet says" not in text
    apart = " ".join(sentences(answer("named", sheets), None, []))
    assert apart.count("the data sheet says") == 2
