"""The learning examples in quick form."""

import pytest

from tests.examples.stories import load_story


@pytest.mark.example
def test_a_layer_in_somebody_elses_module_learns() -> None:
    found = load_story("learning/layer_in_your_module.py").main(iterations=12)
    assert found["before_m"] > 0.02
    assert found["after_m"] < 0.4 * found["before_m"]


@pytest.mark.example
@pytest.mark.parametrize(
    "story",
    [
        pytest.param(
            "ppo_in_ten_lines",
            marks=pytest.mark.short_of("test_ppo_keeps_the_quadcopter_in_the_air"),
        ),
        pytest.param(
            "ppo_on_the_batch",
            marks=pytest.mark.short_of("test_a_loop_written_out_learns_on_gymnasiums_wrappers"),
        ),
    ],
)
def test_ppo_runs_in_short(story: str) -> None:
    pytest.importorskip("stable_baselines3", reason="needs the extra rl")
    found = load_story(f"learning/{story}.py").main(steps=4096, num_envs=32)
    assert all(0.0 < value < 1000.0 for value in found.values())  # steps in the air


@pytest.mark.slow
@pytest.mark.example
def test_ppo_keeps_the_quadcopter_in_the_air() -> None:
    pytest.importorskip("stable_baselines3", reason="needs the extra rl")
    found = load_story("learning/ppo_in_ten_lines.py").main(steps=24_576, num_envs=32)
    assert found["after"] > found["before"] + 15.0


@pytest.mark.slow
@pytest.mark.example
def test_a_loop_written_out_learns_on_gymnasiums_wrappers() -> None:
    """Quadcopters stay longer in the air; at half the steps of the example."""
    pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")
    found = load_story("learning/ppo_on_the_batch.py").main(steps=32_768)
    assert found["last"] > 1.5 * found["first"]


@pytest.mark.example
def test_torchrl_collects() -> None:
    pytest.importorskip("torchrl", reason="TorchRL is no extra of the package; pip install torchrl")
    found = load_story("learning/torchrl_collector.py").main(frames=200)
    assert found["shape"] == (200,)
    assert 0.0 < found["reward"] < 1.0
