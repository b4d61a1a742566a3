"""First sentences: grammar, units and sizes, in at most 25 words."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.records import BaseRow, CauseRow, ErrorRow, Interval
from diffsim.diagnose.say.headline import first_of, headline
from diffsim.diagnose.say.wording import Answer, capital, data_sheets, twin_words

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


def said(verdict, causes, errors=(FELL,), rivals=(), forms=None, gained=None, laws=()) -> str:
    names = tuple(row.name for row in causes)
    decision = SimpleNamespace(forms=forms or {}, best=frozenset(range(len(names))))
    answer = Answer(
        verdict, decision, tuple(causes), rivals, (), None, named=names, best_names=names
    )
    text = headline(answer, list(errors), (), gained, laws)
    assert len(first_of(text).split()) <= 25 and text.endswith(".") and "_" not in text
    return text


def test_an_error_without_a_unit_is_said_over_the_noise():
    """Of two thrust stands it said: from 6.49 to 1.97; 1 is noise."""
    assert said("named", [cause("loss")], [SCALED]) == (
        "Loss is missing (0.1 to 0.5 mrad): error on unseen runs 6.49 to 1.97 times the noise."
    )
    assert said("none", [], [SCALED]).endswith("error on unseen runs is 6.49 times the noise.")


def test_several_things_of_one_name_are_a_plural_and_keep_their_unit():
    """It said: Pulses of 5.038 at drive, ..., from 1.344 s is missing: ... um, noise 1."""
    row = cause("train", words=PULSES, unit="command")
    assert said("named", [row]) == (
        "Pulses of 5.038 at drive, 0.5 s each 1 s, from 1.344 s, are missing: "
        "unseen error 72.4 to 7.21 um, noise 1 um."
    )
    several = [row, cause("stribeck_friction"), cause("dry_friction")]
    assert said("named", several) == (
        "Pulses of 5.038 at drive, stribeck friction and dry friction are missing: "
        "error on unseen runs 72.4 to 7.21 um, noise 1 um."
    )


@pytest.mark.parametrize(
    ("size", "shown"),
    [
        (VECTOR, "(x 6 to 6.2, y -3.1 to -2.9 mrad)"),
        (LONG, "(-3 to 12.5 mrad in 3 sizes)"),
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
            "Table tilt may be missing (-3 to 6.1 mrad in 2 sizes); these runs leave it open"
        )
    lag = [cause("lag", unit="s")]  # of a fan: "is missing", though none was a rival
    text = said("ambiguous", lag, rivals=((), ("delay",)))
    assert text.startswith("Something like lag or delay may be missing"), text
    text = said("ambiguous", lag, rivals=(("delay",),))
    assert text.startswith("Something like lag or delay is missing"), text


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


def test_a_cause_and_a_data_sheet_in_its_place_are_named_where_there_is_room_for_little():
    """A servo four times too strong: one of several causes may be missing, it said."""
    rows, stays = (
        [cause("command_gain_of_servo1")],
        ErrorRow("t", "angle", "deg", 0.0626, 0.0625, 0.0573, 200, 0),
    )
    gained, forms = Gain(0.006, -0.01, 0.02, 1.0, 4), {0: "a wrong data sheet of mass of link1"}
    text = said("ambiguous", rows, (stays,), ((),), forms, gained)
    assert text.startswith("Command gain of servo1 is missing or mass of link1 off; but")


def test_one_of_several_data_sheets_is_said_as_one_of_them():
    """It said: Two data sheets are off, first modulus is 5.09e+05 Pa, not 800000 Pa."""
    rows = [
        replace(cause(name, {"size": Interval(v, v, v)}, unit="Pa"), origin="data sheet", note=note)
        for name, v, note in (
            ("modulus", 5.09e5, "data sheet: 800000 +- 10000 (one standard deviation)"),
            ("density", 900.0, "data sheet: 1000 +- 10 (one standard deviation)"),
        )
    ]
    assert said("data_sheet", rows, ()).startswith(
        "Two data sheets are off, such as modulus: 509000 Pa, not 800000 Pa."
    )


def test_a_cause_and_the_data_sheet_of_its_own_number_are_said_once():
    """It said: Viscosity is missing or viscosity is off its data sheet."""
    forms = {0: "a wrong data sheet of viscosity"}
    assert said("ambiguous", [cause("viscosity")], rivals=((),), forms=forms).startswith(
        "Something like viscosity is missing, or its data sheet is off; these runs cannot tell"
    )
    forms = {0: "a wrong data sheet of density"}
    assert said("ambiguous", [cause("viscosity")], rivals=((),), forms=forms).startswith(
        "Something like viscosity is missing or density is off its data sheet: error on unseen"
    )


def test_beside_what_has_no_name_an_error_that_stays_is_no_objection():
    """It said: Slow share helps, but something without a name is missing, too; but the error
    stays."""
    stays = replace(FELL, after=72.4)
    row = cause("slow_share", helps=True, removes=0.9)
    assert said("unknown", [row], [stays]).startswith(
        "Something without a name is missing beside slow share; the error on unseen runs stays at "
        "72.4 um, noise 1 um."
    )


def test_what_removes_most_is_named_first_and_never_one_of_the_rest():
    """Of an arm it said: Square drag at bend, slow share and 1 more; the one was all of its sag."""
    rows = [
        cause("square_drag", removes=0.02),
        cause("slow_share", removes=0.1),
        cause("ballooning", removes=0.8),
    ]
    assert said("named", rows).startswith("Ballooning (0.1 to 0.5 mrad) and slow share (0.1")
    more = [cause(f"part_{k}", removes=0.15) for k in range(6)]
    assert said("named", more).startswith("Six causes, part 0 first, are missing: error on unseen")


def test_causes_that_remove_little_one_by_one_are_said_as_a_set():
    """Power hardening alone was credited with what four corrections of a stress law remove."""
    names = ("power_hardening", "corotated_share", "yeoh_square")
    rows = [cause(name, removes=0.003, status="likely") for name in names]
    assert said("named", rows).startswith(
        "Power hardening, corotated share and yeoh square together are probably missing: error"
    )
    # what is held, but was not singled out, is counted, too
    rows[2] = replace(rows[2], status="cannot be told from", helps=True)
    assert said("named", rows).startswith(
        "Power hardening and corotated share together are probably missing, with one more cause"
    )


def test_how_sure_each_cause_is_stands_in_the_order_of_what_they_remove():
    slack = cause("slack", removes=0.6, status="likely")
    limit = cause("speed_limit", removes=0.3)
    assert said("named", [limit, slack]).startswith(
        "Probably slack (0.1 to 0.5 mrad) and certainly speed limit (0.1 to 0.5 mrad) are missing"
    )
    slack = replace(slack, removes=0.2)
    assert (
        "speed limit (0.1 to 0.5 mrad) and probably slack" in said("named", [limit, slack]).lower()
    )


def test_a_law_stands_in_front_only_where_causes_of_the_library_remove_less():
    """A law that removes 2 % stood before two certain causes that remove 51."""
    words = "a force at bend that depends on speed"
    law = cause("law_of_speed_at_bend", words=words, removes=0.4, status="likely")
    known = cause("lag", removes=0.51)
    for share, begin in (
        (9.0, "Lag is missing (0.1 to 0.5 mrad): "),  # what removes next to nothing is left out
        (0.5, f"Lag and probably {words} are missing: "),
        (0.2, f"{capital(words)} is probably missing, beside lag: "),
        (0.0, f"No library cause explains it: {words} is probably missing: "),
    ):
        rows = [law, replace(known, removes=share)]
        assert said("named", rows, laws=[law.name]).startswith(begin), share


@pytest.mark.parametrize(
    ("share", "begin"),
    [
        (0.5, "{}, with one more cause left open: "),
        (0.3, "{}, beside perhaps lag: "),
        (0.01, "No cause of the library explains it: {}: "),
    ],
)
def test_a_cause_that_is_held_without_a_name_counts_for_the_library(share, begin):
    """No library cause explained it, it was said, beside one that removed more than the law."""
    law = cause("law_of_speed_at_bend", words="a force that depends on speed", removes=0.4)
    held = cause("lag", removes=share, status="cannot be told from", helps=True)
    text = said("named", [law, held], laws=[law.name])
    is_missing = "a force that depends on speed is missing"
    first = is_missing if begin.startswith("No") else capital(is_missing)
    assert text.startswith(begin.format(first))


def test_causes_beside_a_law_are_counted_as_what_may_be():
    """As if they were as likely as the law: "is probably missing, beside three more"."""
    law = cause("law_of_speed_at_bend", words="a force that depends on speed", removes=0.6)
    long = "a rather long name of something that many words are needed for"
    held = [
        cause(
            f"held_{k}", words=f"{long} {k}", removes=0.1, status="cannot be told from", helps=True
        )
        for k in range(3)
    ]
    assert ", beside perhaps three more: " in said("named", [law, *held], laws=[law.name])


def test_causes_beside_laws_are_named_as_far_as_words_last():
    """A stand of rotors: two laws with long names, beside three causes that have short ones, were
    "two causes, beside perhaps three more", without a single name."""
    long = "an error of the reading of thrust that depends on a product of two variables"
    laws = [
        cause(
            f"law_{k}", words=f"{long} {k}", removes=0.6, status="cannot be told from", helps=True
        )
        for k in range(2)
    ]
    held = [
        cause(name, words=words, removes=removes, status="likely")
        for name, words, removes in (
            ("exponent", "exponent of thrust", 0.2),
            ("torque", "exponent of torque", 0.1),
            ("loss", "loss of thrust at the low end of speeds", 0.09),
        )
    ]
    text = said("named", [*laws, *held], laws=[law.name for law in laws])
    assert text.startswith(
        "Two laws may be missing, beside exponent of thrust, exponent of torque and one more: "
    )


def test_causes_left_open_are_counted_by_what_they_remove():
    """The small ones are none, wherever they stand."""
    open_ones = [
        cause(name, removes=removes, status="cannot be told from", helps=True)
        for name, removes in (("play", 0.001), ("drag", 0.2))
    ]
    for held in (open_ones, open_ones[::-1]):
        assert ", with one more cause left open: " in said(
            "named", [cause("lag", removes=0.6), *held]
        )


def test_a_second_sentence_says_why_and_of_which_cause():
    why = "its size may be zero"
    lag, play = (
        cause("lag", removes=0.6),
        cause("play", removes=0.4, status="likely", doubts=(why,)),
    )
    assert said("named", [lag, play]).endswith(f" Not certain: play, as {why}.")
    both = [replace(row, status="likely", doubts=(why,)) for row in (lag, play)]
    assert said("named", both).endswith(f" Not certain: {why}.")
    assert "Not certain" not in said("named", [lag])


def test_what_may_be_zero_is_not_probably_missing():
    """A law whose size may be zero stood as "is probably missing"."""
    zero = {"status": "likely", "doubts": ("its size may be zero",)}
    drag, lag = (cause(n, removes=0.4, status="likely") for n in ("drag", "lag"))
    play = cause("play", removes=0.3, **zero)
    sure = cause("tilt", removes=0.5)
    for rows, begin in (
        ([play], "Play may be missing (0.1 to 0.5 mrad): "),
        ([drag, lag, play], "Drag, lag and perhaps play are probably missing: "),
        ([sure, drag, play], "Tilt, probably drag and perhaps play are missing: "),
        ([sure, play], "Tilt (0.1 to 0.5 mrad) and perhaps play (0.1 to 0.5 mrad) are missing: "),
        ([cause("play", removes=0.6, **zero), drag], "Perhaps play"),
    ):
        assert said("named", rows).startswith(begin)
    many = [cause(f"drag {k}", removes=0.4, status="likely") for k in range(4)]
    text = said("named", [*many, play])
    assert text.startswith("Up to five causes, drag 0 first, are probably missing: ")
    none = [cause(f"play {k}", removes=0.4, **zero) for k in range(5)]
    assert said("named", none).startswith("Five causes, play 0 first, may be missing: ")


def test_in_whose_place_another_may_act_is_not_probably_missing():
    """A rod's rest bend was "probably missing": a magnet pulled it that the library does not hold.

    Of silicone it said so of a slack that was not singled out.
    """
    bend = cause("bend", removes=0.9, status="likely", doubts=("other causes fit about as well",))
    assert said("named", [bend]).startswith("Bend may be missing (0.1 to 0.5 mrad): ")
    tilt, slack = (cause(n, removes=0.4, status="likely") for n in ("tilt", "slack"))
    answer = Answer("named", SimpleNamespace(forms={}), (tilt, slack), (), (), None, ("tilt",))
    assert headline(answer, [FELL]).startswith(
        "Tilt (0.1 to 0.5 mrad) and perhaps slack (0.1 to 0.5 mrad) are probably missing: "
    )


@pytest.mark.parametrize("after", [72.0, 80.0])
def test_what_the_unseen_error_does_not_bear_out_is_not_probably_missing(after):
    """It said: Flow moment and delay are probably missing; but the error rises."""
    likely = cause("delay", removes=0.4, status="likely")
    for row, verb in ((likely, "may be"), (replace(likely, status="certain"), "is")):
        text = said("named", [row], [replace(FELL, after=after)])
        assert text.startswith(f"Delay {verb} missing (0.1 to 0.5 mrad); but the error on unseen ")


def test_two_forms_of_a_long_name_leave_room_for_the_error():
    words = "a change of the stiffness that depends on the temperature"
    line, power = (cause(n, words=words, removes=0.9, helps=True) for n in ("line", "power"))
    likely = tuple(replace(row, status="cannot be told from") for row in (line, power))
    answer = Answer(
        "ambiguous", SimpleNamespace(forms={}), likely, (("power",),), (), None,
        named=("line",), best_names=("line",),
    )  # fmt: skip
    assert headline(answer, [FELL]).startswith(
        f"Something like {words} is missing: error on unseen runs 72.4 to 7.21 um"
    )


def test_what_is_likely_over_all_sets_is_named_before_what_is_open():
    """Of a friction and a delay in every set it said: Friction with saturation or another cause."""
    rows = [
        cause("friction", removes=0.98, status="likely"),
        cause("delay", removes=0.06, status="likely"),
        cause("saturation", removes=1e-6, status="cannot be told from"),
    ]
    names = tuple(row.name for row in rows)
    rivals = (("friction", "delay"), ("stick", "delay"))
    answer = Answer(
        "ambiguous", SimpleNamespace(forms={}), tuple(rows), rivals, (), None,
        named=names, best_names=names,
    )  # fmt: skip
    assert headline(answer, [FELL]).startswith(
        "Friction and delay are probably missing; these runs leave open whether another cause is"
    )
    open_rows = (replace(rows[0], doubts=("other causes fit about as well",)), *rows[1:])
    assert headline(replace(answer, causes=open_rows), [FELL]).startswith(
        "Delay is probably missing; these runs leave open whether another cause is, too"
    )


def test_what_cannot_be_told_apart_may_be_neither():
    """It said: Command offset or sensor offset is missing; a drift was that the library lacked."""
    untold = {"removes": 0.4, "status": "cannot be told from"}
    rows = [cause(name, **untold) for name in ("command_offset", "sensor_offset")]
    answer = Answer(
        "ambiguous", SimpleNamespace(forms={}), tuple(rows), (("sensor_offset",),), (), None,
        named=("command_offset",), best_names=("command_offset",),
    )  # fmt: skip
    assert headline(answer, [FELL]).startswith(
        "Something like command offset or sensor offset is missing; these runs cannot tell which"
    )
    unlisted = replace(answer, rivals=(("unknown force",),))
    assert headline(unlisted, [FELL]).startswith(
        "Command offset or something without a name is missing; these runs cannot tell which"
    )


def test_a_likely_data_sheet_is_probably_off():
    """It said that two data sheets are off: the rod was thinner than its model."""
    row = replace(
        cause("modulus", unit="Pa", status="likely"), origin="data sheet", note="data sheet: 1"
    )
    assert said("data_sheet", [row]).startswith("Only a data sheet is off: modulus is probably 0.3")
    assert said("data_sheet", [row, row]).startswith("Two data sheets are probably off, such as")


def test_a_surer_data_sheet_goes_before_a_cause_that_may_be_zero():
    """Drives 2.89 times as strong stood behind a sensor's delay of -0.56 to 0.14 ms."""
    zero = cause("delay", removes=1.0, status="likely", doubts=("its size may be zero",))
    first = "this is a first answer"
    strong = cause("kp", unit="N m", status="likely", doubts=(first,))
    strong = replace(strong, origin="data sheet", note="data sheet: 12")
    text = said("named", [zero, strong])
    assert text.startswith("Only a data sheet is off: kp") and text.endswith(f": {first}.")
    doubted = replace(strong, doubts=("an unknown force explains more than it does", first))
    assert said("named", [zero, doubted]).startswith("Delay may be missing")


def test_the_reason_is_a_doubt_of_what_is_named():
    """Friction was in doubt as the spring beside it may have been another form of friction."""
    friction = cause("friction", removes=0.9, status="likely", doubts=("this is a first answer",))
    why = "it may be another form of friction"
    spring = cause("spring", removes=1e-4, status="likely", doubts=(why,))
    text = said("named", [friction, spring])
    assert "spring" not in first_of(text).lower()
    assert text.endswith("Not certain: this is a first answer.")


def test_a_doubt_of_several_causes_is_one_on_them():
    rows = [cause("lag", removes=0.6)]
    for why, plural in (
        ("its size may be zero", "their sizes may be zero"),
        ("it helps nothing on test runs", "they help nothing on test runs"),
        ("a force explains more than it does", "a force explains more than they do"),
        ("a force explains what it leaves", "a force explains what they leave"),
        ("more causes may do without it", "more causes may do without them"),
    ):  # fmt: skip
        two = [cause(n, removes=0.4, status="likely", doubts=(why,)) for n in ("play", "drag")]
        assert said("named", [*rows, *two]).endswith(f" Not certain: play and drag, as {plural}.")


def test_less_than_the_noise_says_that_the_noise_was_stated_too_large():
    """A gain of 126 % was "not confirmed": an error of 1.88 to 0.18 mm under a noise of 0.87."""
    row = ErrorRow("t", "position", "mm", 1.88, 0.184, 0.87, 100, 0)
    text = said("named", [cause("lag")], [row], gained=Gain(1.26, 1.2, 1.3, 3.67, 9))
    assert text.endswith(
        "noise 0.87 mm. The stated noise of 0.87 mm is too large: 0.184 mm is left."
    )


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
    assert headline(answer, [FELL]).startswith("Something like ballooning with drag or lag is miss")


def test_what_a_smaller_set_has_in_common_is_named_before_what_it_lacks():
    rows = [
        cause(name, removes=r, status="likely") for name, r in (("clock", 0.9), ("stretch", 0.1))
    ]
    names, decision = ("clock", "stretch"), SimpleNamespace(forms={})
    answer = Answer(
        "ambiguous", decision, tuple(rows), (("clock",),), (), None, named=names, best_names=names
    )
    assert headline(answer, [FELL]).startswith(
        "Clock is probably missing; these runs leave open whether stretch is, too"
    )


def test_a_data_sheet_that_may_be_wrong_beside_what_all_sets_hold_is_named():
    """A gear of 1.29, or a mass and a loss of 0.77: it said that another cause may be missing."""
    delay, gain = (
        cause("delay", removes=0.9, status="likely"),
        cause("gear", removes=1e-3, status="cannot be told from"),
    )
    forms = {7: "a wrong data sheet of mass of carriage"}
    decision = SimpleNamespace(forms=forms, best=frozenset({3, 7}))
    names = ("delay", "gear")
    answer = Answer(
        "ambiguous", decision, (delay, gain), (("delay",),), (), None, named=names,
        best_names=names,
    )  # fmt: skip
    said = "Delay is probably missing; gear is, too, or mass of carriage is off its data sheet:"
    assert headline(answer, [FELL]).startswith(said)


def test_drives_off_by_one_factor_come_before_a_cause_in_their_place():
    """Four drives four times too strong: one of several causes may be missing, it said."""
    drives = tuple(f"actuator.m{k}.kp" for k in (1, 2))
    sheets = [
        replace(
            cause(name, {"": Interval(2.9 * kp, 2.7 * kp, 4.1 * kp)}, status="likely", unit="-"),
            origin="data sheet", note=f"data sheet: {kp:g} +- 2 (one standard deviation)",
        )
        for name, kp in zip(drives, (12.0, 20.0), strict=True)
    ]  # fmt: skip
    delay = cause("delay", status="cannot be told from")
    decision = SimpleNamespace(forms={4: "a wrong data sheet of kp of m2"}, best=frozenset({4}))
    answer = Answer(
        "ambiguous", decision, (delay, *sheets), ((),), (), None, named=("delay",),
        best_names=("delay",), drives=drives,
    )  # fmt: skip
    strong = "All drives are probably 2.9 times as strong as their data sheets say; the error"
    assert headline(answer, [FELL]).startswith(strong)
    one = replace(answer, drives=(*drives, "actuator.m3.kp"))
    assert headline(one, [FELL]).startswith("Two data sheets are probably off, such as")
    alone = replace(answer, causes=(sheets[0],), drives=drives[:1], verdict="data_sheet")
    assert headline(alone, [FELL]).startswith(
        "The drive is probably 2.9 times as strong as its data"
    )


def test_three_data_sheets_in_place_of_a_cause_are_a_short_sentence():
    """A network's second sentence had 37 words: "its data sheet" stood in it three times."""

    def row(name, value, prior):
        ends = (value, 0.01, value, value, prior, 0.01, 3.0, 3.0)
        return BaseRow(name, name, "-", *ends)

    names = {"width link": 0.985, "width branch 1": 1.04, "width branch 3": 0.977}
    decision = SimpleNamespace(forms={})
    twin = tuple(row(name, times, 1.0) for name, times in names.items())
    answer = Answer("named", decision, (), (), (), None, plain_twin=twin)
    assert twin_words(answer) == (
        "without it the model fits as well, with width link, width branch 1 and width branch 3 at "
        "0.985, 1.04 and 0.977 times their data sheets"
    )
    for prior, said in ((1.0, "at 0.985 times its data sheet"), (0.0, "at 0.985")):
        one = replace(answer, plain_twin=(row("width link", 0.985, prior),))
        assert twin_words(one).endswith(f", with width link {said}")


def test_a_number_that_the_rest_may_bend_is_no_finding():
    """A finger's inertia was "half the data sheet" while the fit left seven times the noise."""

    def row(name):
        return BaseRow(name, name, "-", 0.5, 0.01, 0.5, 0.5, 1.0, 0.01, 9.0, 3.0)

    decision = SimpleNamespace(beside=None, forms={})
    answer = Answer("unknown", decision, (), (), (), None, left=7.0, bent=(row("inertia"),))
    said = "Inertia is off its data sheet: no finding while 7 times the noise is left."
    assert said in data_sheets(answer)
    two = replace(answer, bent=(row("inertia"), row("damping")))
    assert data_sheets(two)[0].startswith("Inertia and damping are off their data sheets")


def test_a_gain_that_a_guessed_width_allows_is_said_and_is_no_finding():
    """A drive with 0.6 times the file's gain was "nothing is missing", 20 % being a guess."""

    def row(name, value, half, pull, **more):
        ends = (value, 0.6 * half, value - half, value + half, 230.0, 46.0, pull, 3.5)
        return BaseRow(name, name.replace("_", " "), "N m/rad", *ends, **more)

    told, further = row("kp_of_joint2", 138.0, 4.0, -2.55), row("kp_of_joint4", 690.0, 9.0, 5.5)
    decision = SimpleNamespace(beside=None, forms={}, best=frozenset())
    answer = Answer("none", decision, (), (), (), None, away=(told,))
    assert headline(answer, [FELL]) == (
        "Nothing is missing; kp of joint2 is fitted at 0.6 (0.58 to 0.62) times what is stated; "
        "unseen error 72.4 um, noise 1 um."
    )
    assert data_sheets(replace(answer, away=(told, further)))[0] == (
        "Fitted within what the study allows: kp of joint2 0.6 (0.58 to 0.62); kp of joint4 3 "
        "(2.96 to 3.04) times what it states."
    )
