"""How far runs lie outside of what was fitted."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.data.study import Channel, Command, Run
from diffsim.diagnose.judge.unseen import outside_rows, spans_of

CHANNELS = (Channel("x_m", "m", "position", sd=0.01),)
TIME = 0.01 * np.arange(500)


def made(name, size, frequency, **setup):
    wave = size * np.sin(2 * np.pi * frequency * TIME)
    return Run(name, TIME, 0.5 * wave[:, None], {"u": wave}, name, setup=setup)


FITTED = (made("a", 1.0, 1.0, frame="A", payload=0.2), made("b", 2.0, 2.0, frame="B", payload=0.2))
SPANS = spans_of(FITTED, CHANNELS)


def far(run):
    return {row.what: row.times for row in outside_rows([run], CHANNELS, SPANS)}


def test_what_was_fitted_is_inside():
    assert all(not far(run) for run in FITTED)
    assert not far(made("between", 1.5, 1.5, frame="A", payload=0.2))


def test_amplitude_rate_and_frequency_are_told_apart():
    large = far(made("large", 6.0, 1.0, frame="A", payload=0.2))
    assert large["stroke of x_m"] == pytest.approx(3.0, rel=0.01)
    assert large["level of u"] == pytest.approx(6.0 / 2.0, rel=0.02)  # fitted: -2 to 2
    assert "frequency of u" not in large
    fast = far(made("fast", 1.0, 4.0, frame="A", payload=0.2))
    assert fast["frequency of u"] == pytest.approx((4.0 - 1.5) / 0.5, rel=0.02)
    assert "stroke of x_m" not in fast
    # a stroke below the fitted ones was passed through
    assert "stroke of x_m" not in far(made("small", 0.2, 1.0, frame="A", payload=0.2))


def test_facts_are_numbers_or_labels():
    found = far(made("new", 1.0, 1.0, frame="C", payload=0.3))
    assert found["frame"] == np.inf
    assert found["payload"] == pytest.approx(0.1 / 0.02)
    (label, payload) = outside_rows(
        [made("new", 1.0, 1.0, frame="C", payload=0.3)], CHANNELS, SPANS
    )
    assert label.words == "Run new: no fitted run has frame C."
    assert payload.words == "Run new: payload is 0.3, fitted runs have 0.2."
    assert not far(replace(FITTED[0], command={"other": FITTED[0].command["u"]}))


@pytest.mark.property
def test_facts_lie_outside_by_their_distance_from_the_middle_of_what_was_fitted():
    rng, levels = np.random.default_rng(2), np.array([-2.0, -1.0, 0.0, 0.0, 0.0, 0.5, 3.0])
    ends = set()
    for ends_and_new in rng.choice(levels, (60, 3)):
        low, high, new = *sorted(ends_and_new[:2]), ends_and_new[2]
        fitted = [made(name, 1.0, 1.0, load=v) for name, v in (("a", low), ("b", high))]
        spans = spans_of(fitted, CHANNELS)
        rows = outside_rows([made("c", 1.0, 1.0, load=new)], CHANNELS, spans)
        middle = 0.5 * (low + high)
        half = max(0.5 * (high - low), 0.1 * abs(middle))  # alike: a tenth of the middle
        times = abs(new - middle) / half if half else np.inf if new else 0.0
        # at its ends rounding is not outside, nor is a range of one value
        is_inside = low <= new <= high or times <= 1.02
        assert [(row.what, row.times) for row in rows] == (
            [] if is_inside else [("load", pytest.approx(times))]
        ), (low, high, new)
        ends.add((is_inside, np.isinf(times)))
    assert ends == {(True, False), (False, False), (False, True)}


def test_commands_have_the_unit_of_the_study():
    commands = (Command("u", "rad"),)
    spans = spans_of(FITTED, CHANNELS, commands)
    run = made("large", 6.0, 1.0, frame="A", payload=0.2)
    units = {row.what: row.unit for row in outside_rows([run], CHANNELS, spans, commands)}
    assert units["rate of u"] == "rad/s"
    assert {r.unit for r in outside_rows([run], CHANNELS, SPANS) if r.what == "rate of u"} == {""}


def test_far_outside_is_a_plain_number():
    """It said: 1e+02 times as far from the middle."""
    rows = outside_rows([made("far", 200.0, 1.0, frame="A", payload=0.2)], CHANNELS, SPANS)
    said = " ".join(row.words for row in rows)
    assert "(100 times as far from the middle)" in said and "e+" not in said
