import numpy as np

from diffsim.diagnose.judge.gain import share_removed


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
    for k in range(300):
        found = share_removed(blocks(rng, null_error=1.0, left=0.3), seed=k, draws=400)
        inside += found.low <= 0.7 <= found.high
    # 90 % of 300 is 270 +- 5.2; a percentile bootstrap of 40 blocks is a little short
    assert 250 <= inside <= 288


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
        assert found.value > 0.9 and found.low > 0.0
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
    assert found.status == "not confirmed"
    assert found.words.endswith("not confirmed; the noise is not what was stated.")


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


def test_no_excess_gives_no_gain():
    table = blocks(np.random.default_rng(2), null_error=0.0, left=1.0)
    table[:, 1:] *= 0.8
    found = share_removed(table, seed=0)
    assert (found.value, found.low, found.high) == (0.0, 0.0, 0.0)
