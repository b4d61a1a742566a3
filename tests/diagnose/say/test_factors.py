"""Sizes that are factors of a slip, in words."""

from dataclasses import replace

import pytest

from diffsim.diagnose.judge.records import CauseRow, Interval
from diffsim.diagnose.say.factors import factor_words, gain_words, sheet_words, stated_of

ROW = CauseRow(
    name="command_gain_of_drive",
    words="command gain of drive",
    origin="effect",
    status="certain",
    probability=1.0,
    size={"size": Interval(3.0, 2.97, 3.02)},
    unit="-",
    smallest_visible={"size": 1e-3},
    shown_unit="%",
)


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (Interval(4.0, 3.98, 4.02), "4 times: is a gear counted twice?"),
        (Interval(0.2501, 0.249, 0.252), "0.25 times: is a gear counted twice?"),
        (Interval(-1.0, -1.01, -0.99), "-1 times: is the sign turned?"),
        (Interval(0.01746, 0.0174, 0.0175), "0.0175 times: are degrees read as radians?"),
        (Interval(9.79, 9.7, 9.9), "9.79 times: are kilograms-force read as newtons?"),
        (Interval(4.0, 3.0, 5.0), ""),  # wide: a dozen factors would do
        (Interval(1.0, 0.99, 1.01), ""),
        (Interval(3.3, 3.25, 3.35), ""),
    ],
)
def test_a_factor_of_a_slip_is_asked_for(found, words):
    assert factor_words(found) == words


def test_a_gain_is_one_and_its_size():
    assert gain_words(ROW) == "4 times: is a gear counted twice?"
    assert gain_words(replace(ROW, name="sensor_scale_of_angle")) != ""
    assert gain_words(replace(ROW, name="load_friction")) == ""
    assert gain_words(replace(ROW, name="command_offset", unit="rad")) == ""


def test_numbers_that_are_off_by_one_factor_are_one_finding_with_its_twin():
    def inertia(name, value, stated, unit="kg"):
        return replace(
            ROW, name=name, words=name, unit=unit, shown_unit=None, origin="data sheet",
            size={"size": Interval(value, 0.995 * value, 1.005 * value)},
            note=f"data sheet: {stated} +- 0.05 (3 sd)",
        )  # fmt: skip

    rows = [inertia("mass of upper", 0.25, 1.0), inertia("mass of fore", 0.3, 1.2)]
    (said,) = sheet_words([(row, stated_of(row)) for row in rows])
    assert said == (
        "Mass of upper and mass of fore are all 0.25 times: is a gear counted twice? The twin of "
        "inertias 0.25 times as large is a drive 4 times as strong: a scale, or a measured force, "
        "decides."
    )
    friction = inertia("friction", 0.4, 0.1, "N m")
    (said,) = sheet_words([(friction, 0.1)])
    assert said == "Friction is 4 times: is a gear counted twice?"
    assert sheet_words([(inertia("mass", 0.8, 1.0), 1.0), (friction, 0.0)]) == []
    assert stated_of(replace(friction, note="nothing")) is None


def test_numbers_that_are_off_by_one_factor_are_one_finding():
    def gain(words, low, high, unit="N m/rad"):
        size = {"": Interval(0.5 * (low + high), low, high)}
        return replace(ROW, name=words, words=words, size=size, unit=unit, shown_unit="")

    rows = [(gain("kp of pan", 25.28, 25.6), 6.0), (gain("kp of lift", 33.64, 34.18), 8.0)]
    assert sheet_words(rows) == ["Kp of pan and kp of lift are all 4.24 times their data sheets."]
    both = ("kp of pan", "kp of lift")
    assert sheet_words(rows, both)[0].endswith(
        "4.24 times their data sheets. The twin of all drives 4.24 times as strong is every mass, "
        "inertia and loss 0.236 times as large: a scale, or a measured force, decides."
    )
    assert "twin" not in sheet_words(rows, (*both, "kp of wrist"))[0], "one is as stated"
    assert (
        "Kp of pan is 4.24 times its data sheet. The twin of all drives"
        in (sheet_words(rows[:1], both[:1])[0])
    )
    apart = [rows[0], (gain("kp of lift", 34.3, 34.8), 8.0)]
    other = [rows[0], (gain("friction", 33.64, 34.18, "N m"), 8.0)]
    wide = [(gain("kp of pan", 22.0, 28.0), 6.0), (gain("kp of lift", 31.0, 37.0), 8.0)]
    for given in (apart, other, wide, rows[:1]):
        assert sheet_words(given) == []
    assert sheet_words(wide, both)[0].startswith(  # known against each other
        "Kp of pan and kp of lift are all 4.21 (3.88 to 4.62) times their data sheets. The twin of"
    )
    assert sheet_words([wide[0], (gain("kp of lift", 26.0, 37.0), 8.0)], both) == []
    (said,) = sheet_words(wide[:1], both[:1])
    assert said.startswith("Kp of pan is 4.17 (3.67 to 4.67) times its data sheet. The twin of all")
    assert sheet_words(wide, (*both, "kp of wrist")) == [], "one is as stated"
    masses = [
        (gain("mass of a", 0.42, 0.43, "kg"), 1.0),
        (gain("mass of b", 0.84, 0.87, "kg"), 2.0),
    ]
    assert (
        "The twin of inertias 0.425 times as large is a drive 2.35 times" in sheet_words(masses)[0]
    )
