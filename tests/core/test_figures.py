"""Numbers as text: no exponents where digits do, and ends of intervals that can be told apart."""

import math

import pytest

from diffsim.core.figures import (
    figure,
    fold_alike,
    limits,
    list_first,
    percent,
    probability,
    signed,
    with_interval,
    with_sd,
)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (2131.4, "2130"),
        (5.74e5, "574000"),
        (3.2e9, "3.2e9"),
        (0.06643, "0.0664"),
        (1.664e-9, "1.66e-9"),
        (-0.0, "0"),
        (math.nan, "–"),
        (math.inf, "∞"),
    ],
)
def test_three_digits_and_exponents_only_where_they_are_shorter(value, text):
    assert figure(value) == text


def test_an_interval_has_as_many_digits_as_tell_its_ends_apart():
    assert with_interval(0.10481, 0.104712, 0.104905) == "0.1048 (0.1047 to 0.1049)"
    assert with_interval(0.021, 0.0193, 0.0227) == "0.021 (0.0193 to 0.0227)"
    assert with_interval(2.0, 2.0, 2.0) == "2 (2 to 2)"


def test_an_end_that_limits_nothing_is_said_to_be_none():
    assert limits(0.06, 0.054, 2.9e6, unit=" N m/A") == (
        "at least 0.054 N m/A; the data give no upper limit"
    )
    assert limits(-0.06, -2.9e6, -0.054) == "at most -0.054; the data give no lower limit"
    assert limits(1.0, 1e-9, 1.2) == "at most 1.2; the data give no lower limit"
    assert limits(1.0, 0.9, math.inf) == "at least 0.9; the data give no upper limit"
    assert limits(1.0, 1e-9, 1e9, unit=" N") == "1e-9 to 1e9 N; the data give no limit"
    # around zero both ends are limits, however small the value between them
    assert limits(0.001, -0.5, 0.5) == "-0.5 to 0.5"
    assert limits(0.001, 0.0, 0.5) == "0 to 0.5"
    assert with_interval(1.18, 1.1, 2e10) == "1.18 (at least 1.1; the data give no upper limit)"


def test_a_value_has_the_digits_of_its_standard_deviation():
    assert with_sd(0.10482, 1e-4) == "0.1048 ± 0.0001"
    assert with_sd(6e5, 4.8e5) == "600000 ± 480000"


def test_zero_has_no_sign_and_no_probability_is_zero():
    assert (signed(-0.04), signed(2.75), signed(-1.6)) == ("0", "+2.8", "-1.6")
    assert (probability(6.6e-162), probability(0.0374)) == ("< 0.001", "0.037")


def test_what_is_said_of_many_files_is_said_once():
    one = "a.mat: no rows"
    assert fold_alike([one, "no colon", "b.mat: Fs: a number", "c.mat: Fs: a number"]) == [
        one,
        "no colon",
        "b.mat, c.mat: Fs: a number",
    ]
    assert fold_alike([f"{n}.mat: lost" for n in "abcd"]) == ["a.mat, b.mat and 2 more: lost"]


@pytest.mark.parametrize(
    ("share", "text"), [(0.436, "44 %"), (0.0052, "0.5 %"), (0.0, "0 %"), (-0.23, "-23 %")]
)
def test_a_share_has_a_space_before_its_sign_and_is_as_exact_as_it_is_small(share, text):
    """A page said 44% beside 44 %."""
    assert percent(share) == text


def test_names_beyond_a_limit_are_counted_but_for_one():
    assert list_first(["a", "b", "c"], 2) == "a, b, c"
    assert list_first(["a", "b", "c", "d"], 2) == "a, b and 2 more"
    assert list_first(["a, b", "c"], 1, "; ") == "a, b; c"
