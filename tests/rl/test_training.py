"""Training scripts: quick runs, resuming, the guard, the critic's targets."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium", reason="environments need gymnasium: pip install '.[rl]'")
pytest.importorskip("stable_baselines3", reason="PPO is stable-baselines3's: pip install '.[rl]'")
pytest.importorskip("tensorboard", reason="training writes a TensorBoard log")

from diffsim.learn import gradient, run, shac
from diffsim.learn.gradient import BadGradients, GradientLearner, GradientOptions, NanGuard
from diffsim.learn.ppo import PpoLearner, PpoOptions
from diffsim.learn.run import Learner, Update, read_rows, train
from diffsim.learn.setup import Setup, evaluate, first_controller
from diffsim.learn.shac import ShacLearner, ShacOptions, td_lambda_targets
from rl import train_gradient, train_ppo, train_shac

TINY = Setup(
    "CopterHover",
    {"seconds": 0.2},
    steps=160,
    evaluate_every=40,
    evaluation_episodes=2,
    warm_up=5,
)
FEW = GradientOptions(batch=4)


def learner(method: str, setup: Setup = TINY) -> Learner:
    """Small ones."""
    if method == "gradient":
        return GradientLearner(setup, FEW)
    if method == "shac":
        return ShacLearner(setup, ShacOptions(batch=4, window=5, critic_passes=1))
    return PpoLearner(setup, PpoOptions(envs=4, rollout=10, minibatch=20, epochs=1))


@pytest.mark.parametrize("script", [train_gradient, train_shac, train_ppo])
def test_quick_runs_write_results_a_checkpoint_and_a_log(script: Any, tmp_path: Path) -> None:
    script.main(["--quick", "--out", str(tmp_path)])
    rows = read_rows(tmp_path)
    assert rows[0]["steps"] == 0 and rows[-1]["finished"]
    assert rows[-1]["steps"] >= 320
    assert all(math.isfinite(r["reward"]) for r in rows)
    assert rows[-1]["seconds"] > 0.0
    assert (tmp_path / run.CHECKPOINT).exists()
    assert list(tmp_path.glob("events.out.tfevents*"))


def test_open_loop_controllers_are_fitted_by_l_bfgs(tmp_path: Path) -> None:
    out = train_gradient.main(["--controller", "knots", "--quick", "--out", str(tmp_path)])
    written = json.loads((tmp_path / "open_loop.json").read_text())
    assert max(written["rewards"]) == max(out["rewards"])
    assert len(written["parameters"]["raw"]) == 20


@pytest.mark.parametrize("method", ["gradient", "shac", "ppo"])
def test_methods_start_from_the_same_controller(method: str) -> None:
    first = first_controller(TINY.make_task(), TINY.seed, TINY.warm_up)
    made = learner(method).controller()
    x = torch.from_numpy(np.random.default_rng(0).standard_normal((5, 22)))
    tolerance = 1e-6 if method == "ppo" else 0.0  # stable-baselines3 computes in single precision
    torch.testing.assert_close(made(x), first(x), rtol=tolerance, atol=tolerance)


def test_ppos_policy_is_the_controller_it_is_rated_as() -> None:
    made = PpoLearner(TINY, PpoOptions(envs=4, rollout=10, minibatch=20, epochs=1))
    made.update(0.0)
    x = np.random.default_rng(0).standard_normal((5, 22))
    theirs, _ = made.model.predict(made.venv.normalize_obs(x), deterministic=True)
    ours = made.controller()(torch.from_numpy(x)).detach().numpy()
    np.testing.assert_allclose(ours, theirs, atol=2e-6)


class Interrupted:
    """A learner whose user presses Ctrl-C at some update."""

    def __init__(self, inner: Learner, at: int):
        self.inner, self.left = inner, at

    def update(self, progress: float) -> Update:
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt
        return self.inner.update(progress)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)


@pytest.mark.parametrize("method", ["gradient", "shac"])
def test_an_interrupted_run_continues_bit_for_bit(method: str, tmp_path: Path) -> None:
    whole = learner(method)
    straight = train(TINY, whole, tmp_path / "a", show=False)
    cut: Any = Interrupted(learner(method), at=3)
    with pytest.raises(KeyboardInterrupt):
        train(TINY, cut, tmp_path / "b", show=False)
    again = learner(method)
    resumed = train(TINY, again, tmp_path / "b", resume=True, show=False)
    for key, value in whole.controller().state_dict().items():
        assert torch.equal(value, again.controller().state_dict()[key]), key
    for key in ("steps", "reward", "forward_equivalents"):
        assert [r[key] for r in resumed.rows] == [r[key] for r in straight.rows]


def test_ppo_continues_from_its_checkpoint(tmp_path: Path) -> None:
    cut: Any = Interrupted(learner("ppo"), at=2)
    with pytest.raises(KeyboardInterrupt):
        train(TINY, cut, tmp_path, show=False)
    resumed = train(TINY, learner("ppo"), tmp_path, resume=True, show=False)
    assert resumed.finished and resumed.updates == 4


def test_a_checkpoint_of_another_run_is_refused(tmp_path: Path) -> None:
    train(TINY, learner("gradient"), tmp_path, show=False)
    other = Setup(**{**vars(TINY), "seed": 1})
    with pytest.raises(ValueError, match="seed must be 0"):
        train(other, learner("gradient", other), tmp_path, resume=True, show=False)


def test_the_guard_skips_bad_batches_and_gives_up_after_too_many() -> None:
    guard, one, nan = NanGuard(3), torch.tensor(1.0), torch.tensor(math.nan)
    assert guard.good(one, one)
    assert not guard.good(one, nan) and not guard.good(None, None)
    assert guard.good(one, one) and guard.total == 2
    assert not guard.good(nan, one) and not guard.good(one, torch.tensor(math.inf))
    with pytest.raises(BadGradients, match="3 updates in a row"):
        guard.good(nan, nan)


def test_an_update_without_finite_gradient_leaves_the_controller_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = GradientLearner(TINY, FEW)
    before = {k: v.clone() for k, v in made.net.state_dict().items()}

    def broken(*args: Any, **options: Any) -> Any:
        raise ValueError("state must be finite, got 3 NaN or infinite entries")

    monkeypatch.setattr(gradient, "rollout_task", broken)
    assert made.update(0.0).scalars["train/bad_updates"] == 1.0
    assert all(torch.equal(v, before[k]) for k, v in made.net.state_dict().items())

    def mistaken(*args: Any, **options: Any) -> Any:
        raise ValueError("action must have shape (4, 4)")

    monkeypatch.setattr(gradient, "rollout_task", mistaken)
    with pytest.raises(ValueError, match="shape"):  # a mistake is not a breakdown
        made.update(0.0)


def test_a_short_training_by_gradient_hovers_better() -> None:
    setup = Setup("CopterHover", {"seconds": 1.0}, warm_up=20)
    made = GradientLearner(setup, GradientOptions(batch=16, learning_rate=1e-2))
    before = evaluate(made.task, made.net, 8)
    for k in range(25):
        made.update(k / 25)
    gain = evaluate(made.task, made.net, 8) - before
    assert gain > 0.3 * (1.0 - before)


def test_critic_targets_agree_with_a_hand_computed_case() -> None:
    # two members; the first fails at its second step, the second is cut by time there
    rewards = torch.tensor([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]).double()
    values = torch.tensor([[10.0, 10.0], [20.0, 20.0], [30.0, 30.0]]).double()
    failed = torch.tensor([[False, False], [True, False], [False, False]])
    ended = torch.tensor([[False, False], [True, True], [False, False]])
    got = td_lambda_targets(rewards, values, failed, ended, discount=0.9, trace=0.5)
    third = 3.0 + 0.9 * 30.0
    failing, cut = 2.0, 2.0 + 0.9 * 20.0
    want = [
        [1.0 + 0.9 * (0.5 * 10.0 + 0.5 * failing), 1.0 + 0.9 * (0.5 * 10.0 + 0.5 * cut)],
        [failing, cut],
        [third, third],
    ]
    torch.testing.assert_close(got, torch.tensor(want).double())


def test_critic_targets_without_ends_are_the_lambda_mix_of_n_step_returns() -> None:
    steps, discount, trace = 5, 0.95, 0.7
    generator = torch.Generator().manual_seed(0)
    rewards, values = (torch.rand(steps, 1, generator=generator).double() for _ in range(2))
    no = torch.zeros(steps, 1, dtype=torch.bool)
    got = td_lambda_targets(rewards, values, no, no, discount=discount, trace=trace)

    def n_step(n: int) -> float:
        parts = [discount**k * float(rewards[k]) for k in range(n)]
        return sum(parts) + discount**n * float(values[n - 1])

    mix = sum((1 - trace) * trace ** (n - 1) * n_step(n) for n in range(1, steps))
    assert float(got[0]) == pytest.approx(mix + trace ** (steps - 1) * n_step(steps))


def test_a_window_pays_rewards_and_what_comes_after_but_nothing_after_a_failure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = ShacLearner(TINY, ShacOptions(batch=2, window=2, discount=0.9))
    made.state["step"].zero_()
    task = made.task
    monkeypatch.setattr(made.target, "forward", lambda x: 0.0 * x[:, 0] + 7.0)
    monkeypatch.setattr(
        task, "step", lambda s, a: (s | {"step": s["step"] + 1}, 0.0 * a[:, 0] + 1.0)
    )
    monkeypatch.setattr(task, "failed", lambda s: torch.tensor([True, False]) & (s["step"] == 1))
    loss, window = made._window()
    # first: 1, failure, then a fresh episode 1 + 0.9 * 7; its failure again pays no value
    first = 1.0 + 1.0
    second = 1.0 + 0.9 + 0.81 * 7.0
    assert float(loss.detach()) == pytest.approx(-(first + second) / 2 / 2)
    assert window.ended.tolist() == [[True, False], [True, False]]


def test_a_cosine_falls_from_one_to_a_tenth() -> None:
    assert gradient.cosine_rate(1.0, 0.0) == 1.0
    assert gradient.cosine_rate(1.0, 0.5) == pytest.approx(0.55)
    assert gradient.cosine_rate(1.0, 2.0) == pytest.approx(0.1)


def test_the_critic_is_not_bounded() -> None:
    critic = shac.Critic(3, 0.99, seed=0)
    assert critic.scale == pytest.approx(100.0)
    assert float(critic(1e3 * torch.ones(1, 3).double()).detach().abs()) > 1.0
