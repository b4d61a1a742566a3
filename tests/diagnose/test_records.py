"""Rows of a report in the units of the user."""

from __future__ import annotations

from dataclasses import replace

import pytest

from diffsim.diagnose.answer import size_range
from diffsim.diagnose.records import BaseRow, CauseRow, Interval

PLAY = CauseRow(
    name="sensor_backlash",
    words="sensor backlash",
    origin="effect",
    status="certain",
    probability=1.0,
    size={"size": Interval(0.000889, 0.000873, 0.000905)},
    unit="m",
    smallest_visible={"size": 1e-5},
    shown_unit="mm",
)


def test_sizes_are_said_in_the_unit_of_the_user_and_kept_in_si():
    assert size_range(PLAY) == "0.87 to 0.91 mm"
    assert size_range(replace(PLAY, shown_unit=None)) == "0.00087 to 0.0009 m"
    read = PLAY.as_read()
    assert read.unit == "mm" and read.as_read() is read
    assert read.smallest_visible["size"] == pytest.approx(0.01)
    assert PLAY.size["size"].value == 0.000889


def test_a_shape_of_a_cause_that_is_absent_is_told_by_nothing():
    row = BaseRow("slow_time", "slow time", "s", 0.5, 0.5, 0.1, 2.0, 0.5, 0.5, 0.0, 3.0)
    assert not row.is_told
    assert replace(row, sd=0.1).is_told and replace(row, pull=-2.0).is_told
