"""First sentences: grammar, units and sizes, in at most 25 words."""

from types import SimpleNamespace

import pytest

from diffsim.diagnose.judge.records import CauseRow, ErrorRow, Interval
from diffsim.diagnose.say.headline import headline
from diffsim.diagnose.say.wording import Answer

PULSES = "pulses of 5.038 at drive, 0.5 s each 1 s, from 1.344 s"
FELL = ErrorRow("t", "position", "um", 72.4, 7.21, 1.0, 100, 0)
SCALED = ErrorRow("t", "force", "-", 12.98, 3.94, 2.0, 100, 0)
VECTOR = {c: Interval(v, v - 0.1, v + 0.1) for c, v in {"x": 6.1, "y": -3.0}.items()}
LONG = {**VECTOR, "z": Interval(12.5, 12.0, 13.0)}
MANY = {f"[fan={k}]": Interval(0.1 * k, 0.0, 1.0) for k in range(1, 8)}


def cause(name, size=None, *, words=None, status="certain", unit="mrad", **more) -> CauseRow:
    size = size or {"size": Interval(0.3, 0.1, 0.5)}
    words = words or name.replace("_", " ")
    return CauseRow(name, words, "effect", status, 0.9, size, unit, **more)


def said(verdict, causes, errors=(FELL,), rivals=(), forms=None) -> str:
    names = tuple(row.name for row in causes)
    decision = SimpleNamespace(forms=forms or {})
    answer = Answer(
        verdict, decision, tuple(causes), rivals, (), None, named=names, best_names=names
    )
    text = headline(answer, list(errors))
    assert len(text.split()) <= 25 and text.endswith(".") and "_" not in text
    return text


def test_an_error_without_a_unit_is_said_over_the_noise():
    """Of two thrust stands it said: from 6.49 to 1.97; 1 is noise."""
    assert said("named", [cause("loss")], [SCALED]) == (
        "Loss is missing (0.1 to 0.5 mrad). "
        "It takes the error on unseen runs from 6.49 to 1.97 times the noise."
    )
    assert said("none", [], [SCALED]).endswith("error on unseen runs is 6.49 times the noise.")


def test_several_things_of_one_name_are_a_plural_and_keep_their_unit():
    """It said: Pulses of 5.038 at drive, ..., from 1.344 s is missing: ... um, noise 1."""
    row = cause("train", words=PULSES, unit="command")
    assert said("named", [row]) == (
        "Pulses of 5.038 at drive, 0.5 s each 1 s, from 1.344 s, are missing: "
        "error 72.4 to 7.21 um, noise 1 um."
    )
    several = [row, cause("stribeck_friction"), cause("dry_friction")]
    assert said("named", several) == (
        "Pulses of 5.038 at drive, stribeck friction and 1 more are missing: "
        "error on unseen runs 72.4 to 7.21 um, noise 1 um."
    )
    one = cause("train", words="pulses of 3 N at cart")
    assert ". They take the error" in said("named", [one])


@pytest.mark.parametrize(
    ("size", "shown"),
    [
        (VECTOR, "(x 6 to 6.2, y -3.1 to -2.9 mrad)"),
        (LONG, "(x 6 to 6.2, y -3.1 to -2.9, z 12 to 13 mrad)"),
        (MANY, "(0.1 to 0.7 mrad in 7 sizes)"),
    ],
)
def test_sizes_of_several_components_are_said(size, shown):
    text = said("named", [cause("table_tilt", size)])
    assert text.startswith(f"Table tilt is missing {shown}")
    assert "72.4 to 7.21 um" in text


def test_of_two_causes_with_components_the_span_is_said_where_all_would_be_too_long():
    two = [cause("table_tilt", LONG), cause("drag", unit="-")]
    assert said("named", two).startswith(
        "Table tilt (-3 to 12.5 mrad in 3 sizes) and drag (0.1 to 0.5) are missing"
    )


def test_what_is_asked_for_without_a_rival_may_be_missing():
    """It said: One of several causes is missing."""
    causes = [cause("table_tilt", VECTOR, status="cannot be told from")]
    for rivals in ((), ((),)):
        assert said("ambiguous", causes, rivals=rivals).startswith(
            "Table tilt may be missing (x 6 to 6.2, y -3.1 to -2.9 mrad)"
        )


def test_a_relative_size_has_no_unit():
    text = said("named", [cause("dead_band", unit="command"), cause("lag", unit="s")])
    assert text.startswith("Dead band (0.1 to 0.5) and lag (0.1 to 0.5 s) are missing")


def test_a_data_sheet_has_digits_that_tell_it_from_the_answer():
    row = CauseRow(
        "mass", "mass", "data sheet", "certain", None,
        {"mass": Interval(1.5004, 1.5003, 1.5005)}, "kg", note="data sheet: 1.5 +- 0.0001 (pull 4)",
    )  # fmt: skip
    text = said("data_sheet", [row])
    assert text.startswith("Only a data sheet is off: mass is 1.5004 kg, not 1.5 kg; the error")


def test_what_removes_most_is_named_first_and_never_one_of_the_rest():
    """Of an arm it said: Square drag at bend, slow share and 1 more; the one was all of its sag."""
    rows = [
        cause("square_drag", removes=0.02),
        cause("slow_share", removes=0.1),
        cause("ballooning", removes=0.8),
    ]
    assert said("named", rows).startswith("Ballooning, slow share and 1 more are missing")


def test_a_likely_cause_that_removes_more_than_a_certain_one_is_not_hidden():
    slack = cause("slack", removes=0.6, status="likely")
    limit = cause("speed_limit", removes=0.3)
    assert said("named", [limit, slack]).startswith(
        "Speed limit is missing (0.1 to 0.5 mrad), and probably slack"
    )
    assert "slack" not in said("named", [limit, cause("slack", removes=0.1, status="likely")])


def test_in_a_set_that_cannot_be_told_apart_what_removes_most_comes_first():
    rows = [
        cause("ballooning", removes=0.8, status="cannot be told from"),
        cause("drag", removes=0.1, status="cannot be told from"),
    ]
    decision = SimpleNamespace(forms={})
    names = ("drag", "ballooning")
    answer = Answer(
        "ambiguous", decision, tuple(rows), (("lag",),), (), None, named=names, best_names=names
    )
    assert headline(answer, [FELL]).startswith("Ballooning with drag or lag is missing")
