from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from diffsim.data.study import Run
from diffsim.diagnose.judge.gain import Gain, compared, share_removed
from diffsim.diagnose.judge.records import ErrorRow
from diffsim.diagnose.say.headline import judged_headline
from tests.diagnose import linear

STEP_S = 0.01


def blocks(rng, *, null_error, left, num_blocks=40, length=30):
    """Noise of variance one plus smooth errors of both models, whose sums of squares are kept."""
    noise = rng.normal(size=(num_blocks, length))
    shape = rng.normal(size=(num_blocks, 1)) * np.ones((1, length))
    null = noise + null_error * shape
    extended = noise + np.sqrt(left) * null_error * shape
    return np.column_stack([np.full(num_blocks, length), (null**2).sum(1), (extended**2).sum(1)])


def test_interval_covers_the_true_share():
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(300):
        found = share_removed(blocks(rng, null_error=1.0, left=0.3), seed=0)
        inside += found.low <= 0.7 <= found.high
    # 90 % of 300 is 270 +- 5.2
    assert 255 <= inside <= 285


def recorded_gain(rng, memory, *, num_samples=2000, num_runs=1, size=3.0, left=0.35):
    """Gain from runs whose misfit forgets over ``memory`` samples; ``left`` of its square stays."""
    decay = float(np.exp(-1.0 / memory)) if memory else 0.0

    def misfit(share):
        steps = rng.normal(size=(num_samples + 1000, 2)) * np.sqrt(1.0 - decay**2)
        return np.sqrt(share) * size * lfilter([1.0], [1.0, -decay], steps, axis=0)[1000:]

    runs, before, after = [], [], []
    for k in range(num_runs):
        noise, stays = rng.normal(size=(num_samples, 2)), misfit(left)
        goes = misfit(1.0 - left)
        time = STEP_S * np.arange(num_samples)
        runs.append(Run(f"r{k}", time, np.zeros((num_samples, 2)), {}, f"r{k}"))
        before.append((noise + stays + goes).ravel())
        after.append((noise + stays).ravel())
    fit = type("Frozen", (), {"problem": linear.problem(runs=tuple(runs))})()
    return compared(runs, fit, before, after, seed=0)


@pytest.mark.parametrize(("memory", "size"), [(0, 3.0), (10, 3.0), (50, 3.0), (50, 0.5)])
def test_intervals_cover_a_known_gain_where_the_misfit_is_correlated(memory, size):
    """Also where noise hides the correlation. Of the third, blocks of 0.3 s cover 145 of 200."""
    rng = np.random.default_rng(4)
    found = [recorded_gain(rng, memory, size=size) for _ in range(200)]
    inside = sum(g.low <= 0.65 <= g.high for g in found)
    assert 160 <= inside <= 194


def test_blocks_are_as_long_as_the_misfit_remembers_and_no_longer_than_a_run():
    counts = [recorded_gain(np.random.default_rng(k), 50).num_blocks for k in range(5)]
    assert min(counts) >= 4 and max(counts) <= 64  # of 256
    rng = np.random.default_rng(5)
    short = [recorded_gain(rng, 50, num_samples=60, num_runs=7).num_blocks for _ in range(5)]
    assert min(short) == 7


def test_worse_models_are_withdrawn_and_equal_ones_not_confirmed():
    rng = np.random.default_rng(1)
    assert share_removed(blocks(rng, null_error=1.0, left=0.0), seed=0).status == "confirmed"
    assert share_removed(blocks(rng, null_error=1.0, left=2.0), seed=0).status == "withdrawn"
    same = blocks(rng, null_error=1.0, left=1.0)
    found = share_removed(same, seed=0)
    assert found.value == 0.0
    assert found.status == "not confirmed"


def test_a_single_reading_confirms_nothing():
    rng = np.random.default_rng(3)
    for count in (1, 3, 4):
        table = blocks(rng, null_error=2.0, left=0.0, num_blocks=count)
        found = share_removed(table, seed=0)
        assert found.value > 0.9
        assert found.status == ("confirmed" if count == 4 else "not confirmed")
        assert ("too few for an interval" in found.words) == (count < 4)


def quieter(rng, left_sd, null_error):
    """Blocks whose noise is less than was stated, and nothing else is left."""
    table = blocks(rng, null_error=null_error, left=0.0, num_blocks=200)
    noise = table[:, 2].copy()
    table[:, 2] *= left_sd**2
    table[:, 1] += table[:, 2] - noise
    return table


def test_more_than_all_of_the_error_says_that_the_noise_is_not_what_was_stated():
    """218 % removed was "confirmed": a third of the stated noise was left."""
    found = share_removed(quieter(np.random.default_rng(4), 0.4, 1.3), seed=0)
    assert found.value > 1.2 and found.low > 1.0
    assert found.status == "confirmed" and np.sqrt(found.left) == pytest.approx(0.4, abs=0.02)
    assert found.words.endswith("confirmed; the stated noise is too large, 40 % of it is left.")


def test_next_to_nothing_and_a_fit_that_ran_away_refute_nothing():
    """A left-out fit that was 442 times as wrong, -195,430 of the share, refuted a cause."""
    rng = np.random.default_rng(6)
    worse = share_removed(blocks(rng, null_error=1.0, left=30.0), seed=0)
    assert worse.status == "withdrawn"
    away = share_removed(blocks(rng, null_error=1.0, left=1e5), seed=0)
    assert away.high < 0.0 and away.status == "cannot be judged" and "ran away" in away.words
    nothing = Gain(-0.4, -0.6, -0.2, 0.01, 20)
    assert nothing.status == "cannot be judged" and "next to nothing" in nothing.words
    assert "%" not in away.words and "%" not in nothing.words  # a share of that says nothing
    assert Gain(-0.4, -0.6, -0.2, 0.1, 20).status == "withdrawn"


def test_noise_that_is_hardly_less_than_stated_is_confirmed():
    found = share_removed(quieter(np.random.default_rng(4), 0.95, 1.0), seed=0)
    assert 1.0 < found.value < 1.2 and found.status == "confirmed"
    small = share_removed(quieter(np.random.default_rng(4), 0.95, 0.45), seed=0)
    assert small.value > 1.2 and not small.is_below_noise  # a small excess says little
    assert "stated" not in small.words


def test_an_error_falls_for_sure_though_its_share_says_little():
    """The excess of a weak cause is lost in the scatter of the noise, its removal is not."""
    rng = np.random.default_rng(5)
    found = share_removed(blocks(rng, null_error=0.15, left=0.0, num_blocks=60), seed=0)
    assert found.low < 0.005 and found.status != "confirmed" and found.has_fallen
    same = share_removed(blocks(rng, null_error=0.15, left=1.0, num_blocks=60), seed=0)
    assert not same.has_fallen
    few = share_removed(blocks(rng, null_error=0.15, left=0.0, num_blocks=3), seed=0)
    assert not few.has_fallen


def test_a_single_reading_withdraws_nothing():
    worse = np.array([[30.0, 60.0, 90.0], [30.0, 61.0, 89.0]])
    assert share_removed(worse, seed=0).status == "withdrawn"
    alone = share_removed(worse[:1], seed=0)
    assert alone.value == -1.0 and alone.status == "not confirmed"


def test_what_gets_much_worse_is_withdrawn_where_the_null_model_is_near_the_noise():
    """Half of the blocks are below the noise: they have no excess, but lose as much."""
    null = np.where(np.arange(12) % 2, 36.0, 27.0)
    table = np.column_stack([np.full(12, 30.0), null, 20.0 * null])
    assert share_removed(table, seed=0).status == "withdrawn"


def test_no_excess_gives_no_gain():
    table = blocks(np.random.default_rng(2), null_error=0.0, left=1.0)
    table[:, 1:] *= 0.8
    found = share_removed(table, seed=0)
    assert (found.value, found.low, found.high) == (0.0, 0.0, 0.0)


def test_a_gain_that_own_values_pay_for_is_not_confirmed():
    sure = Gain(0.8, 0.7, 0.9, 3.0, 20, farthest=(2.9, "zero closing"))
    bought = replace(sure, farthest=(5.0, "zero closing"))
    assert (sure.status, bought.status) == ("confirmed", "not confirmed")
    assert bought.words.endswith("zero closing is 5 standard deviations off in them.")
    row = ErrorRow("a", "position", "mm", 2.0, 1.1, 1.0, 100, 1)
    assert (
        "the gain needs zero closing 5 standard deviations off on unseen runs"
        in judged_headline([row], bought, extended=True)
    )
    assert "Not certain" not in judged_headline([row], sure, extended=True)
