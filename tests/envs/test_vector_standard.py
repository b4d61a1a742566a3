"""The native batch as gymnasium's own vector environments: autoreset modes, seeds, masks."""

import numpy as np
import pytest
import torch

gymnasium = pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

from gymnasium.vector import AutoresetMode, SyncVectorEnv  # noqa: E402
from gymnasium.wrappers import vector as wrappers  # noqa: E402

import diffsim.envs as envs  # noqa: E402

ID, OPTIONS = "diffsim/CopterTrack-v0", {"seconds": 0.12}  # six steps
SEEDS = [11, 5, 0]


def native(mode: AutoresetMode | str = "NextStep", **more: object) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec(ID, num_envs=3, autoreset_mode=mode, **(OPTIONS | more))


def of_gymnasium(mode: AutoresetMode) -> SyncVectorEnv:
    make = lambda: gymnasium.make(ID, **OPTIONS)  # noqa: E731
    return SyncVectorEnv([make] * 3, autoreset_mode=mode)


def actions(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1.0, 1.0, (count, 3, 4)).astype(np.float32)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_every_step_is_that_of_gymnasiums_sync_vector_env(mode: AutoresetMode) -> None:
    """Two and a half episodes of members with seeds of their own, one of which fails early."""
    ours, theirs = native(mode), of_gymnasium(mode)
    assert ours.metadata["autoreset_mode"] == mode
    options = {"position": np.array([1.0, 0.5, 0.0])}
    pairs = [env.reset(seed=SEEDS, options=dict(options))[0] for env in (ours, theirs)]
    np.testing.assert_allclose(*pairs, rtol=1e-6, atol=1e-7)
    for k, row in enumerate(actions(15)):
        if k == 2:  # the second member is lost from here on
            ours.state["position"][1] += 100.0
            theirs.envs[1].unwrapped.state["position"] += 100.0
        one, other = ours.step(row), theirs.step(row)
        for mine, his in zip(one[:4], other[:4], strict=True):
            np.testing.assert_allclose(mine, his, rtol=1e-5, atol=1e-6)
        none = [None] * 3
        lasts = [[r is None for r in step[4].get("final_obs", none)] for step in (one, other)]
        assert lasts[0] == lasts[1]
        for name in ("alive", "_alive"):
            if name in other[4] and mode == AutoresetMode.NEXT_STEP:
                np.testing.assert_allclose(one[4][name], other[4][name])


def test_disabled_waits_for_a_mask() -> None:
    env = native(AutoresetMode.DISABLED)
    env.reset(seed=SEEDS)
    rows = actions(8)
    for row in rows[:6]:
        *_, truncated, _ = env.step(row)
    assert truncated.all()
    with pytest.raises(ValueError, match="reset_mask"):
        env.step(rows[6])
    mask, before = np.array([True, False, True]), env.state["position"].clone()
    options = {"reset_mask": mask}
    observations, _ = env.reset(options=options)
    assert options == {"reset_mask": mask}  # wrappers read it after us
    assert env.state["step"].tolist() == [0, 6, 0]
    assert torch.equal(env.state["position"][1], before[1])
    assert (env.state["position"][[0, 2]] != before[[0, 2]]).all()
    assert observations.shape == env.observation_space.shape
    with pytest.raises(ValueError, match="member 1"):
        env.step(rows[6])
    env.reset(options={"reset_mask": ~mask})
    env.step(rows[7])


def test_seeds_by_member() -> None:
    env, single = native(sensor_noise=0.1), gymnasium.make(ID, sensor_noise=0.1, **OPTIONS)
    observations, _ = env.reset(seed=SEEDS)
    for row, seed in zip(observations, SEEDS, strict=True):
        np.testing.assert_array_equal(row, single.reset(seed=seed)[0])
    again, _ = env.reset(seed=[None, 5, None])
    np.testing.assert_array_equal(again[1], observations[1])
    assert (again[[0, 2]] != observations[[0, 2]]).any()
    whole, _ = env.reset(seed=7)  # one seed is a batch's again
    np.testing.assert_array_equal(env.reset(seed=7)[0], whole)
    for bad, words in (([1, 2], "3 entries"), ([1, 2, -1], "-1"), ([1, 2, 0.5], "0.5")):
        with pytest.raises(ValueError, match=words):
            env.reset(seed=bad)


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (np.ones(2, dtype=bool), r"\(3,\)"),
        (np.ones(3), "bool"),
        (np.zeros(3, dtype=bool), "at least one"),
        ([True, True, False], "numpy"),
    ],
)
def test_masks_that_are_none(mask: object, words: str) -> None:
    env = native()
    env.reset(seed=0)
    with pytest.raises((TypeError, ValueError), match=words):
        env.reset(options={"reset_mask": mask})


def test_a_mask_needs_a_first_reset() -> None:
    with pytest.raises(ValueError, match="reset_mask"):
        native().reset(options={"reset_mask": np.array([True, False, False])})


def test_options_set_what_an_episode_starts_with() -> None:
    env = gymnasium.make("diffsim/CopterHover-v0").unwrapped
    env.reset(seed=0, options={"position": [1.0, 0.0, -2.0], "wind": 0.0})
    assert env.state["position"].tolist() == [[1.0, 0.0, -2.0]]
    state = env.differentiable_state()
    first, _ = env.reset(seed=1, options=state)  # all of a state
    second, _ = env.reset(seed=2, options=state)
    np.testing.assert_array_equal(first, second)
    vector = envs.make_vector("CopterHover", 2)
    vector.reset(seed=0, options={"velocity": [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]})
    assert vector.state["velocity"][:, 0].tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"positon": 0.0}, "position"),
        ({"position": [0.0, 1.0]}, "shape"),
        ({"position": float("nan")}, "finite"),
        ({"reset_mask": np.array([True])}, "reset_mask"),
    ],
)
def test_options_that_an_environment_does_not_know(options: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        gymnasium.make("diffsim/CopterHover-v0").reset(options=options)


def test_gymnasiums_vector_wrappers_take_the_native_batch() -> None:
    """Those that demand an autoreset mode, and those that read an episode's end."""
    env: gymnasium.vector.VectorEnv = native()
    env = wrappers.RecordEpisodeStatistics(env)
    env = wrappers.NormalizeObservation(env)
    env = wrappers.NormalizeReward(env)
    env = wrappers.ClipAction(env)
    env.reset(seed=0)
    ends = []
    for row in actions(14):
        *_, info = env.step(row)
        if "episode" in info:
            ends.append(info["episode"]["l"][info["_episode"]].tolist())
    assert ends == [[6, 6, 6], [6, 6, 6]]
    listed = wrappers.DictInfoToList(native())
    listed.reset(seed=0)
    assert "alive" in listed.step(actions(1)[0])[-1][2]


def test_video_of_the_native_batch(tmp_path) -> None:
    env = gymnasium.make_vec(
        ID, num_envs=2, autoreset_mode="NextStep", render_mode="rgb_array", **OPTIONS
    )
    env.reset(seed=0)
    assert env.render()[0].shape == (360, 480, 3)
    assert env.metadata["render_fps"] == 50


def test_bad_modes_are_named() -> None:
    with pytest.raises(ValueError, match="NextStep"):
        native("nextstep")


def test_stable_baselines3_needs_the_same_step() -> None:
    pytest.importorskip("stable_baselines3")
    with pytest.raises(ValueError, match="SAME_STEP"):
        envs.Sb3VecEnv(envs.make_vector("CopterHover", 2, autoreset_mode="NextStep"))
