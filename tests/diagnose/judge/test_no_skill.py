"""What takes no skill stands beside the model: the best constant, and the first reading held."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.data.study import Channel
from diffsim.diagnose.checks.one_run import MIN_SAMPLES
from diffsim.diagnose.judge.records import ErrorRow, no_skill_words
from diffsim.diagnose.judge.unseen import constants_of, on_unseen
from diffsim.diagnose.say.headline import judged_headline
from diffsim.identify import fit
from tests.diagnose import linear

SD = np.array([c.sd for c in linear.CHANNELS])


def test_constant_and_first_reading_are_those_of_the_records():
    runs = [linear.run("r1", 1), linear.run("r2", 2)]
    blank = runs[1].measured.copy()
    blank[:4, 0] = np.nan
    new = replace(linear.run("new", 3), measured=7.0 + linear.run("new", 3).measured)
    new.measured[0, 1] = np.nan
    fitted = [runs[0], replace(runs[1], measured=blank)]
    means = constants_of(fitted, linear.CHANNELS)
    together = np.concatenate([r.measured for r in fitted])
    assert means == pytest.approx(dict(zip("ab", np.nanmean(together, axis=0), strict=True)))
    assert constants_of(fitted, (Channel("a", "m", "position"), Channel("b", "m", "position")))
    at = fit(linear.model(), runs, linear.CHANNELS)
    found = on_unseen(at, at, [new], linear.CHANNELS, SD, {}, seed=0, constants=means)
    (row,) = found.errors
    left = new.measured - np.array([means["a"], means["b"]])
    assert row.constant == pytest.approx(np.sqrt(np.nanmean(left**2)))
    first = np.array([new.measured[0, 0], new.measured[1, 1]])
    assert row.held == pytest.approx(np.sqrt(np.nanmean((new.measured - first) ** 2)))
    # files of before know no constant
    (before,) = on_unseen(at, at, [new], linear.CHANNELS, SD, {}, seed=0).errors
    assert before.constant is None and before.held == row.held
    for length in (MIN_SAMPLES, MIN_SAMPLES - 1):
        short = replace(new, time_s=new.time_s[:length], measured=new.measured[:length])
        (row,) = on_unseen(at, at, [short], linear.CHANNELS, SD, {}, seed=0).errors
        assert (row.held is None) == (length < MIN_SAMPLES)


def test_a_gain_that_is_worse_than_a_constant_is_said():
    """Of a starfish "79 % removed, confirmed" was said where a constant was better."""
    row = ErrorRow("cyclic", "position", "mm", 9.0, 3.0, 0.5, 100, 1, constant=2.5, held=4.0)
    (said,) = no_skill_words([row])
    assert said == (
        "Run cyclic: the model has no skill in position: it leaves 3 mm, "
        "a constant would leave 2.5 mm."
    )
    head = judged_headline([row], None, extended=True)
    assert head == (
        "The extended model has no skill: error on unseen runs 9 to 3 mm, a constant leaves 2.5 mm."
    )
    for better in (3.0, 2.99, 5.0, None):
        skilled = replace(row, constant=better)
        assert no_skill_words([skilled]) == []
        assert judged_headline([skilled], None, extended=True).startswith("With the extended")
    assert (
        "the first reading, held, would leave 1 mm" in no_skill_words([replace(row, held=1.0)])[0]
    )
