"""A window where there can be one, and a hint where there cannot."""

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

from diffsim.envs import window  # noqa: E402

ID = "diffsim/CopterHover-v0"


def test_without_a_display_the_hint_says_what_works(monkeypatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.setattr(window, "_interactive", lambda: None)
    for make in (gymnasium.make, lambda i, **o: gymnasium.make_vec(i, num_envs=2, **o)):
        with pytest.raises(gymnasium.error.DependencyNotInstalled, match="rgb_array") as caught:
            make(ID, render_mode="human")
        assert "pip install" in str(caught.value)


def test_the_window_shows_every_state(monkeypatch) -> None:
    """On a canvas in memory: the same calls, no window."""
    monkeypatch.setattr(window, "_interactive", lambda: "agg")
    env = gymnasium.make(ID, render_mode="human", seconds=0.1)
    twin = gymnasium.make(ID, render_mode="rgb_array", seconds=0.1)
    action = np.full(4, 0.8, dtype=np.float32)
    for each in (env, twin):
        each.reset(seed=0)
    first = env.unwrapped.window.shown
    np.testing.assert_array_equal(first, twin.render())
    for each in (env, twin):
        each.step(action)
    np.testing.assert_array_equal(env.unwrapped.window.shown, twin.render())
    assert (env.unwrapped.window.shown != first).any()
    assert env.render() is None
    env.close()
    assert env.unwrapped.window is None


def test_the_batch_shows_its_members_side_by_side(monkeypatch) -> None:
    monkeypatch.setattr(window, "_interactive", lambda: "agg")
    env = gymnasium.make_vec(ID, num_envs=3, render_mode="human")
    env.reset(seed=0)
    env.step(np.zeros((3, 4), dtype=np.float32))
    assert env.unwrapped.window.shown.shape == (720, 960, 3)  # two by two, one empty
    env.close()
