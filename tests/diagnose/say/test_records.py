"""Rows of a report in the units of the user."""

from dataclasses import replace

import pytest

from diffsim.diagnose.judge.records import BaseRow, CauseRow, Interval
from diffsim.diagnose.say.wording import size_range

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
    read = PLAY.as_read()
    assert read.unit == "mm" and read.as_read() is read
    assert read.smallest_visible["size"] == pytest.approx(0.01)
    assert PLAY.size["size"].value == 0.000889


def test_small_sizes_without_a_unit_of_the_user_are_read_with_a_prefix():
    plain = replace(PLAY, shown_unit=None)
    assert size_range(plain) == "0.87 to 0.91 mm"
    assert size_range(replace(plain, unit="s")) == "0.87 to 0.91 ms"
    assert size_range(replace(plain, unit="N")) == "0.87 to 0.91 mN"
    open_ = replace(plain, unit="N", size={"size": Interval(1.2, 1.1, 3e7)})
    assert size_range(open_) == "at least 1.1 N; the data give no upper limit"
    both = replace(open_, size={"x": Interval(2.0, 1.0, 3.0), **open_.size})
    assert size_range(both) == "x 1 to 3 N; size at least 1.1 N; the data give no upper limit"
    far = {**PLAY.size, "z": Interval(0.3, 0.2, 0.4)}
    assert size_range(replace(plain, size=far)) == "size 0.00087 to 0.0009, z 0.2 to 0.4 m"
    unseen = replace(plain, size={}).as_read()
    assert unseen.unit == "um" and unseen.smallest_visible["size"] == pytest.approx(10.0)


def test_small_angles_of_a_file_in_rad_are_read_in_mrad():
    """The unit of the recordings is a prefix away: 0.0123 rad are 12 mrad."""
    zero = replace(PLAY, unit="rad", shown_unit="rad", size={"size": Interval(0.012, 0.011, 0.013)})
    assert size_range(zero) == "11 to 13 mrad"
    assert zero.as_read().as_read() == zero.as_read()
    assert size_range(replace(zero, shown_unit="deg")) == "0.63 to 0.74 deg"


def test_a_limit_that_is_stored_as_time_per_way_is_read_as_a_speed():
    size = {"size": Interval(9.1, 8.8, 9.4)}
    shown = {"shown_unit": "mm/s", "shown_times": 1e3, "shown_power": -1}
    limit = replace(PLAY, unit="s/command", size=size, **shown)
    assert size_range(limit) == "106 to 114 mm/s"
    read = limit.as_read()
    found = read.size["size"]
    assert (found.value, found.low) == pytest.approx((1e3 / 9.1, 1e3 / 9.4))
    assert found.high == pytest.approx(1e3 / 8.8)
    assert read.as_read() is read and not read.smallest_visible
    # one over a size that may be zero has no bound
    open_ended = replace(limit, size={"size": Interval(1.0, 0.0, 2.0)})
    assert open_ended.as_read() is open_ended


def test_a_limit_that_is_stored_as_one_over_a_force_is_read_as_that_force():
    size = {"size": Interval(1.25, 1.0, 2.0)}
    limit = replace(PLAY, unit="1/(N m)", size=size, shown_unit="N m", shown_power=-1)
    assert size_range(limit) == "0.5 to 1 N m"
    in_parts = replace(limit, unit="1/(kN m)", shown_unit="N m")
    assert in_parts.as_read().size["size"].value == pytest.approx(800.0)


def test_a_share_is_read_in_percent():
    scale = replace(PLAY, unit="-", shown_unit="%", size={"size": Interval(-0.02, -0.021, -0.019)})
    assert size_range(scale) == "-2.1 to -1.9 %"


def test_a_shape_of_a_cause_that_is_absent_is_told_by_nothing():
    row = BaseRow("slow_time", "slow time", "s", 0.5, 0.5, 0.1, 2.0, 0.5, 0.5, 0.0, 3.0)
    assert not row.is_told
    assert replace(row, sd=0.1).is_told and replace(row, pull=-2.0).is_told
