"""Training scripts: quick runs, resuming, the guard, the critic's targets."""

import dataclasses
import importlib
import json
import math
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium", reason="environments need gymnasium: pip install '.[rl]'")

from diffsim.core.errors import DiffsimError
from diffsim.learn import gradient, open_loop
from diffsim.learn.checkpoint import CHECKPOINT
from diffsim.learn.cma_es import steer_members
from diffsim.learn.critics import Critic, td_lambda_targets
from diffsim.learn.gradient import BadGradients, GradientLearner, GradientOptions, NanGuard
from diffsim.learn.methods import make_learner
from diffsim.learn.open_loop import fit_open_loop, make_open_loop
from diffsim.learn.run import (
    Learner,
    Update,
    is_finished,
    load_controller,
    read_rows,
    train,
)
from diffsim.learn.setup import Setup, evaluate, first_controller
from diffsim.learn.shac import ShacLearner, ShacOptions
from rl import train_gradient
from tests.kills import Killed, killing_replace
from tests.optional import needs

needs("stable_baselines3", reason="PPO is stable-baselines3's: pip install '.[rl]'")
needs("tensorboard", reason="training writes a TensorBoard log")
needs("cma", reason="CMA-ES is the package cma: pip install '.[rl]'")


TINY = Setup(
    "CopterHover",
    {"seconds": 0.2},
    steps=160,
    evaluate_every=40,
    evaluation_episodes=2,
    warm_up=5,
)
FEW = GradientOptions(batch=4)


SMALL: dict[str, dict[str, Any]] = {
    "gradient": {"batch": 4},
    "shac": {"batch": 4, "window": 5, "critic_passes": 1},
    "sapo": {"batch": 4, "window": 5, "critic_passes": 1},
    "mixed": {"batch": 4},
    "ppo": {"envs": 4, "rollout": 10, "minibatch": 20, "epochs": 1},
    "sac": {"envs": 4, "rollout": 10, "minibatch": 20, "passes": 2, "first": 40, "keep": 400},
    "tqc": {"envs": 4, "rollout": 10, "minibatch": 20, "passes": 2, "first": 40, "keep": 400},
    "cma": {"population": 4},
}


def learner(method: str, setup: Setup = TINY) -> Learner:
    """Small ones."""
    return make_learner(method, setup, SMALL[method])


@pytest.mark.parametrize(
    "script", ["gradient", "shac", "sapo", "mixed", "ppo", "sac", "tqc", "cma"]
)
def test_quick_runs_write_results_a_checkpoint_and_a_log(script: str, tmp_path: Path) -> None:
    importlib.import_module(f"rl.train_{script}").main(["--quick", "--out", str(tmp_path)])
    rows = read_rows(tmp_path)
    assert rows[0]["steps"] == 0 and rows[-1]["finished"]
    assert rows[-1]["steps"] >= 320
    assert all(math.isfinite(r["reward"]) for r in rows)
    assert rows[-1]["seconds"] > 0.0
    assert (tmp_path / CHECKPOINT).exists()
    assert list(tmp_path.glob("events.out.tfevents*"))


def test_a_run_starts_from_the_controller_of_another(tmp_path: Path) -> None:
    before, made = TINY, learner("gradient")
    train(before, made, tmp_path / "before", show=False)
    after = dataclasses.replace(TINY, seed=5, start=str(tmp_path / "before"))
    begun, want = learner("gradient", after).controller(), made.controller()
    for name, value in want.state_dict().items():
        assert torch.equal(begun.state_dict()[name], value), name
    run = train(after, learner("gradient", after), tmp_path / "after", show=False)
    rated = read_rows(tmp_path / "before")[-1]["reward"]
    assert run.rows[0]["reward"] == pytest.approx(rated)
    with pytest.raises(ValueError, match="start must be"):  # one resumes as one began
        train(
            dataclasses.replace(after, start=""),
            learner("gradient"),
            tmp_path / "after",
            resume=True,
            show=False,
        )


def test_a_controller_of_another_robot_is_no_start(tmp_path: Path) -> None:
    train(TINY, learner("gradient"), tmp_path, show=False)
    other = dataclasses.replace(TINY, task="CopterTrack", start=str(tmp_path))
    with pytest.raises(ValueError, match="must be one of 28 observations and 4 actions"):
        other.first_controller(other.make_task())
    with pytest.raises(ValueError, match="no networks; leave it out"):
        learner("cma", dataclasses.replace(TINY, start=str(tmp_path)))
    with pytest.raises(FileNotFoundError):
        dataclasses.replace(TINY, start=str(tmp_path / "none")).first_controller(TINY.make_task())


def test_open_loop_controllers_are_fitted_by_l_bfgs(tmp_path: Path) -> None:
    out = train_gradient.main(["--controller", "knots", "--quick", "--out", str(tmp_path)])
    written = json.loads((tmp_path / "open_loop.json").read_text())
    assert max(written["rewards"]) == max(out["rewards"])
    assert len(written["parameters"]["raw"]) == 20


def test_open_loop_fit_backs_off_from_what_breaks_down(monkeypatch: pytest.MonkeyPatch) -> None:
    task = TINY.make_task()
    first = make_open_loop("knots", task, 1).raw.detach().clone()  # type: ignore[union-attr]
    free = fit_open_loop(task, make_open_loop("knots", task, 1), seed=0, max_iterations=4)
    reach = 0.5 * float(np.linalg.norm(free.history[1].x - free.history[0].x))
    simulated = open_loop.rollout_task

    def fragile(task: Any, controller: Any, *rest: Any) -> Any:
        if float((controller.raw - first).norm().detach()) > reach:
            raise ValueError("x must be finite, got nan")
        return simulated(task, controller, *rest)

    monkeypatch.setattr(open_loop, "rollout_task", fragile)
    controller = make_open_loop("knots", task, 1)
    found = fit_open_loop(task, controller, seed=0, max_iterations=4)
    assert found.num_failed > 0 and found.final.value < found.history[0].value
    np.testing.assert_array_equal(controller.raw.detach().numpy().ravel(), found.final.x)  # type: ignore[union-attr, arg-type]
    reach = -1.0
    with pytest.raises(DiffsimError, match="broke down"):
        fit_open_loop(task, controller, seed=0, max_iterations=4)


@pytest.mark.parametrize("method", ["gradient", "shac", "sapo", "mixed", "ppo", "sac", "tqc"])
def test_methods_start_from_the_same_controller(method: str) -> None:
    first = first_controller(TINY.make_task(), TINY.seed, TINY.warm_up)
    made = learner(method).controller()
    x = torch.from_numpy(np.random.default_rng(0).standard_normal((5, 22)))
    single = method in ("ppo", "sac", "tqc")  # computed in single precision
    tolerance = 1e-6 if single else 0.0
    torch.testing.assert_close(made(x), first(x), rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize(
    ("method", "options"),
    [("ppo", {}), ("ppo", {"hold_noise": 4}), ("sac", {}), ("tqc", {})],
)
def test_a_policy_of_stable_baselines3_is_the_controller_it_is_rated_as(
    method: str, options: dict[str, Any]
) -> None:
    made: Any = make_learner(method, TINY, SMALL[method] | options)
    for _ in range(3):
        made.update(0.0)
    x = np.random.default_rng(0).standard_normal((5, 22))
    theirs, _ = made.model.predict(made.venv.normalize_obs(x), deterministic=True)
    ours = made.controller()(torch.from_numpy(x)).detach().numpy()
    np.testing.assert_allclose(ours, theirs, atol=2e-6)


IN_ALGORITHM = {  # what stable-baselines3 calls an option
    "ppo": {"rollout": "n_steps", "epochs": "n_epochs", "discount": "gamma", "entropy": "ent_coef",
            "trace": "gae_lambda", "minibatch": "batch_size", "hold_noise": "sde_sample_freq"},
    "sac": {"minibatch": "batch_size", "soft": "tau", "discount": "gamma", "keep": "buffer_size",
            "first": "learning_starts", "passes": "gradient_steps"},
}  # fmt: skip


@pytest.mark.parametrize("method", IN_ALGORITHM)
def test_every_option_stands_in_the_algorithm_and_is_spent(method: str) -> None:
    made: Any = learner(method)
    for name, theirs in IN_ALGORITHM[method].items():
        said, found = getattr(made.options, name), getattr(made.model, theirs)
        assert found == (said or -1 if name == "hold_noise" else said), name
    assert made.update(0.25).steps == made.options.envs * made.options.rollout
    if method == "ppo":  # annealed over the budget
        assert made.rate == pytest.approx(0.75 * made.options.learning_rate)
    assert made.venv.gamma == made.options.discount


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


@cache
def trained_straight(method: str) -> tuple[Learner, Any]:
    """A whole run without an interruption: the learner at its end, and the run."""
    whole = learner(method)
    with tempfile.TemporaryDirectory() as folder:
        return whole, train(TINY, whole, Path(folder), show=False)


@pytest.mark.parametrize("method", ["gradient", "shac", "sapo", "mixed", "cma"])
def test_an_interrupted_run_continues_bit_for_bit(method: str, tmp_path: Path) -> None:
    whole, straight = trained_straight(method)
    cut: Any = Interrupted(learner(method), at=3)
    with pytest.raises(KeyboardInterrupt):
        train(TINY, cut, tmp_path / "b", show=False)
    again = learner(method)
    resumed = train(TINY, again, tmp_path / "b", resume=True, show=False)
    for key, value in whole.controller().state_dict().items():
        assert torch.equal(value, again.controller().state_dict()[key]), key
    for key in ("steps", "reward", "forward_equivalents"):
        assert [r[key] for r in resumed.rows] == [r[key] for r in straight.rows]


@pytest.mark.parametrize(
    ("last", "before"), [(1, False), (5, True), (8, True), (8, False), (9, True), (9, False)]
)
def test_killed_at_any_file_it_continues_bit_for_bit(
    last: int, before: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kill between checkpoint and ratings must not make a run of an older state 'finished'."""
    whole, straight = trained_straight("gradient")
    with pytest.raises(Killed), monkeypatch.context() as patch:
        patch.setattr("diffsim.core.files.os.replace", killing_replace(last, before=before))
        train(TINY, learner("gradient"), tmp_path / "b", show=False)
    again = learner("gradient")
    if is_finished(tmp_path / "b"):  # then nobody trains on: what is there must be the end
        load_controller(tmp_path / "b", again.controller())
        rows = read_rows(tmp_path / "b")
    else:
        rows = train(TINY, again, tmp_path / "b", resume=True, show=False).rows
    for key, value in whole.controller().state_dict().items():
        assert torch.equal(value, again.controller().state_dict()[key]), key
    assert [r["reward"] for r in rows] == [r["reward"] for r in straight.rows]
    assert [r["reward"] for r in read_rows(tmp_path / "b")] == [r["reward"] for r in rows]


@pytest.mark.parametrize("method", ["ppo", "sac", "tqc"])
def test_stable_baselines3_continues_from_its_checkpoint(method: str, tmp_path: Path) -> None:
    cut: Any = Interrupted(learner(method), at=2)
    with pytest.raises(KeyboardInterrupt):
        train(TINY, cut, tmp_path, show=False)
    again: Any = learner(method)
    again.load_state_dict(torch.load(tmp_path / CHECKPOINT, weights_only=True)["learner"])
    for (key, old), new in zip(
        cut.controller().state_dict().items(), again.controller().state_dict().values(), strict=True
    ):
        assert torch.equal(old, new), key
    resumed = train(TINY, learner(method), tmp_path, resume=True, show=False)
    assert resumed.finished and resumed.updates == 4


def test_sac_remembers_its_transitions() -> None:
    made: Any = learner("sac")
    for _ in range(3):
        made.update(0.0)
    again: Any = learner("sac")
    again.load_state_dict(made.state_dict())
    old, new = made.model.replay_buffer, again.model.replay_buffer
    assert new.pos == old.pos == 30
    np.testing.assert_array_equal(new.observations[:30], old.observations[:30])
    assert np.abs(new.observations[:30]).max() > 0.0
    assert torch.equal(again.model.log_ent_coef, made.model.log_ent_coef)
    assert float(made.model.log_ent_coef.detach()) != 0.0


def test_noise_that_is_held_is_one_function_of_the_state_for_some_steps() -> None:
    made: Any = make_learner("ppo", TINY, SMALL["ppo"] | {"hold_noise": 4})
    x = torch.from_numpy(np.random.default_rng(0).standard_normal((4, 22))).float()
    policy = made.model.policy
    first, again = (policy.get_distribution(x).get_actions() for _ in range(2))
    assert torch.equal(first, again)
    policy.reset_noise(4)
    fresh = policy.get_distribution(x).get_actions()
    away = (fresh - policy.get_distribution(x).mode()).detach().square().mean().sqrt()
    assert 0.1 < float(away) < 1.0  # of the order of ``exploration``


def test_members_are_steered_by_parameters_of_their_own() -> None:
    task = TINY.make_task()
    for kind in ("sinusoid", "knots"):
        made = [make_open_loop(kind, task, seed) for seed in range(3)]
        many = {
            k: torch.stack([dict(m.named_parameters())[k].detach() for m in made])
            for k, _ in made[0].named_parameters()
        }
        seen = torch.zeros(3, task.num_observations, dtype=torch.float64)
        want = torch.stack([m(seen[0], 7) for m in made])
        torch.testing.assert_close(steer_members(made[0], many)(seen, 7), want)


def test_cma_es_finds_a_signal_of_known_best(monkeypatch: pytest.MonkeyPatch) -> None:
    made: Any = make_learner("cma", TINY, {"population": 8, "spread": 0.3})
    best = np.linspace(-0.5, 0.5, 9)
    monkeypatch.setattr(
        made, "_rewards", lambda rows: torch.from_numpy(-np.square(rows - best).sum(1))
    )
    for _ in range(60):
        made.update(0.0)
    np.testing.assert_allclose(made.search.mean, best, atol=0.05)
    found = torch.cat([p.detach().flatten() for p in made.controller().parameters()])
    np.testing.assert_allclose(found.numpy(), made.search.mean)


def test_the_first_window_may_train_the_critic_alone() -> None:
    made = ShacLearner(TINY, ShacOptions(batch=4, window=5, critic_passes=1, warm_up=1))
    actor = [p.detach().clone() for p in made.net.parameters()]
    critic = [p.detach().clone() for p in made.critics.members.parameters()]
    made.update(0.0)
    assert all(torch.equal(a, b) for a, b in zip(actor, made.net.parameters(), strict=True))
    assert not torch.equal(critic[0], next(made.critics.members.parameters()))
    made.update(0.1)
    assert not torch.equal(actor[0], next(made.net.parameters()))


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


@pytest.mark.story  # training
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
    monkeypatch.setattr(made.critics.targets[0], "forward", lambda x: 0.0 * x[:, 0] + 7.0)
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


def test_the_critic_starts_near_zero_and_is_not_bounded() -> None:
    critic = Critic(3, 0.99, seed=0)
    assert critic.scale == pytest.approx(100.0)
    x = torch.from_numpy(np.random.default_rng(0).standard_normal((50, 3)))
    assert float(critic(x).detach().abs().max()) < 5.0  # of 100: the actor follows its slope
    with torch.no_grad():
        critic.layers[-1].weight.mul_(1e3)
    assert float(critic(x).detach().abs().max()) > 100.0
