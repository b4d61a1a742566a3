"""The mix of first- and zeroth-order gradients, on tasks small enough to know the answer."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

pytest.importorskip("gymnasium", reason="environments need gymnasium: pip install '.[rl]'")

from diffsim.control import MLPController
from diffsim.envs.registry import make_task
from diffsim.envs.task import Entry, Task, TaskState
from diffsim.learn import mixed
from diffsim.learn.methods import make_learner
from diffsim.learn.mixed import (
    MixedLearner,
    MixedOptions,
    advantages,
    both_gradients,
    episode_gradients,
    first_order_weight,
)
from diffsim.learn.setup import Setup, evaluate, first_controller
from rl import presets
from rl.quality import _per_episode

SPREAD = 0.2


class Toy(Task):
    """One number that moves and is rewarded.

    Args:
        move: Place and action (batch,) -> place.
        reward: Of the place.
        steps: Of an episode.
        limit: Place beyond which an episode fails.
    """

    name = "Toy"
    dt = 1.0
    actions = (Entry("push", -1.0, 1.0),)
    observations = (Entry("place", -math.inf, math.inf),)

    def __init__(
        self,
        move: Callable[[Tensor, Tensor], Tensor],
        reward: Callable[[Tensor], Tensor],
        steps: int,
        limit: float = math.inf,
    ):
        super().__init__()
        self.move, self.reward, self.max_steps, self.limit = move, reward, steps, limit

    def rest(self, batch: int, rng: np.random.Generator) -> TaskState:
        return {"x": torch.from_numpy(rng.uniform(-0.5, 0.5, batch))}

    def advance(self, state: TaskState, action: Tensor) -> TaskState:
        return {"x": self.move(state["x"], action[:, 0])}

    def observe(self, state: TaskState) -> Tensor:
        return state["x"][:, None]

    def reward_terms(self, before: TaskState, action: Tensor, after: TaskState) -> TaskState:
        return {"place": self.reward(after["x"])}

    def failed(self, state: TaskState) -> Tensor:
        return state["x"] > self.limit


def smooth(limit: float = math.inf) -> Toy:
    """Nonlinear in place and command; fails beyond the limit."""
    return Toy(lambda x, a: 0.9 * torch.sin(x) + 0.5 * a, lambda x: torch.exp(-x * x), 4, limit)


def small_net(seed: int = 3) -> MLPController:
    """Seven parameters."""
    return MLPController(1, 1, hidden=(2,), normalize=False, seed=seed, output_gain=0.7)


def sample(task: Toy, net: nn.Module, episodes: int, seed: int) -> tuple[Tensor, Tensor]:
    """Both gradients per episode."""
    rng = np.random.default_rng(seed)
    start = task.start(episodes, rng)
    noise = SPREAD * torch.from_numpy(rng.standard_normal((task.max_steps, episodes, 1)))
    _, first, zeroth = both_gradients(task, net, start, noise, SPREAD)
    return first, zeroth


def differences(
    task: Toy, net: nn.Module, episodes: int, seed: int, h: float
) -> tuple[Tensor, Tensor]:
    """Finite differences of the smoothed objective, and their standard errors."""
    means, errors = [], []
    flat = nn.utils.parameters_to_vector(net.parameters()).detach()
    for k in range(len(flat)):
        sides = []
        for sign in (1.0, -1.0):
            moved = flat.clone()
            moved[k] += sign * h
            nn.utils.vector_to_parameters(moved, net.parameters())
            rng = np.random.default_rng(seed)  # the same starts and noise on both sides
            state = task.start(episodes, rng)
            total, going = torch.zeros(episodes).double(), torch.ones(episodes, dtype=torch.bool)
            noise = SPREAD * torch.from_numpy(rng.standard_normal((task.max_steps, episodes, 1)))
            with torch.no_grad():
                for e in noise:
                    state, reward = task.step(state, net(task.observe(state)) + e)
                    total += reward * going
                    going &= ~task.failed(state)
            sides.append(total / task.max_steps)
        slopes = (sides[0] - sides[1]) / (2.0 * h)
        means.append(slopes.mean())
        errors.append(slopes.std() / episodes**0.5)
    nn.utils.vector_to_parameters(flat, net.parameters())
    return torch.stack(means), torch.stack(errors)


def standard_error(samples: Tensor) -> Tensor:
    """Of the mean of rows."""
    return samples.std(0) / len(samples) ** 0.5


SIGMAS = 4.5  # seven parameters leave this by chance once in twenty thousand seeds


@pytest.mark.grad
def test_both_gradients_are_those_of_the_smoothed_objective() -> None:
    task, net = smooth(), small_net()
    want, doubt = differences(task, net, 100_000, 1, 1e-3)
    for k, estimate in enumerate(sample(task, net, 100_000, 2)):
        error = (standard_error(estimate).square() + doubt.square()).sqrt()
        assert float(error.norm()) < (0.02, 0.1)[k] * float(want.norm())  # could tell a mistake
        assert bool(((estimate.mean(0) - want).abs() < SIGMAS * error).all()), k


@pytest.mark.grad
def test_failures_are_seen_by_the_zeroth_order_gradient_alone() -> None:
    # Suh et al. 2022, section 3: where a reward jumps the first-order gradient is biased
    task, net = smooth(limit=0.3), small_net()
    want, doubt = differences(task, net, 40_000, 1, 0.05)
    first, zeroth = sample(task, net, 40_000, 2)
    off = [
        (g.mean(0) - want).abs() / (standard_error(g).square() + doubt.square()).sqrt()
        for g in (first, zeroth)
    ]
    assert float(off[1].max()) < SIGMAS
    assert float(off[0].max()) > 2.0 * SIGMAS


@pytest.mark.reference
def test_a_step_function_has_no_first_order_gradient_and_gets_no_weight() -> None:
    # P(mu + SPREAD e > 0) = Phi(mu / SPREAD), whose slope is known
    task = Toy(lambda x, a: a, lambda x: (x > 0.0).double() + 0.0 * x, 1)
    net = MLPController(1, 1, hidden=(), normalize=False, output_gain=0.0)
    with torch.no_grad():
        net.layers[0].bias.fill_(0.1)
    mu = math.tanh(0.1)
    slope = math.exp(-0.5 * (mu / SPREAD) ** 2) / math.sqrt(2.0 * math.pi) / SPREAD
    want = slope * (1.0 - mu**2)  # for the bias, the second parameter
    first, zeroth = sample(task, net, 4_000, 0)
    assert float(first.abs().max()) == 0.0
    error = float(standard_error(zeroth)[1])
    assert abs(float(zeroth.mean(0)[1]) - want) < SIGMAS * error < 0.2 * want
    assert first_order_weight(first, zeroth, 1.0) == 1.0  # variance alone is deceived
    few, many = (first_order_weight(first[:n], zeroth[:n], 0.95) for n in (400, 4_000))
    assert many < few < 1.0 and many < 0.25


def test_gradients_that_explode_get_no_weight() -> None:
    def chaotic(x: Tensor, a: Tensor) -> Tensor:
        return 1.0 - 1.9 * x * x + 0.02 * a  # Lyapunov exponent about 0.5 a step

    alphas = []
    for steps in (1, 6, 40):
        both = sample(Toy(chaotic, lambda x: x, steps), small_net(), 64, 0)
        alphas.append(first_order_weight(*both, 0.95))
    assert alphas[0] > 0.9 and alphas[0] > alphas[1] > alphas[2] and alphas[2] < 1e-6


@pytest.mark.reference
def test_the_weight_agrees_with_hand_computed_cases() -> None:
    def weight(first: list[list[float]], zeroth: list[list[float]], confidence: float) -> float:
        return first_order_weight(
            torch.tensor(first).double(), torch.tensor(zeroth).double(), confidence
        )

    # variances 2 and 8 + 2; means (2, 0) and (2, 1) are 1 apart, less than sqrt(10 / (2 * 0.05))
    first, zeroth = [[1.0, 0.0], [3.0, 0.0]], [[0.0, 2.0], [4.0, 0.0]]
    assert weight(first, zeroth, 1.0) == pytest.approx(10.0 / 12.0)
    assert weight(first, zeroth, 0.95) == pytest.approx(10.0 / 12.0)
    # variances 0 and 2; means are 8 apart, bound sqrt(2 / (2 * 0.25)) = 2
    first, zeroth = [[10.0], [10.0]], [[1.0], [3.0]]
    assert weight(first, zeroth, 1.0) == 1.0
    assert weight(first, zeroth, 0.75) == pytest.approx(0.25)
    assert weight([[1.0], [1.0]], [[1.0], [1.0]], 0.95) == 1.0  # neither varies, both agree
    assert weight([[1e200], [-1e200]], zeroth, 0.95) == 0.0  # the variance overflows


def test_advantages_agree_with_a_hand_computed_case() -> None:
    # the third episode fails in its first step, the second in its second
    rewards = torch.tensor([[1.0, 2.0, 6.0], [3.0, 5.0, 0.0], [4.0, 0.0, 0.0]]).double()
    alive = torch.tensor([[True, True, True], [True, True, False], [True, False, False]])
    want = [
        [8.0 - (7.0 + 6.0) / 2.0, 7.0 - (8.0 + 6.0) / 2.0, 6.0 - (8.0 + 7.0) / 2.0],
        [7.0 - 5.0, 5.0 - 7.0, 0.0],
        [4.0, 0.0, 0.0],
    ]
    torch.testing.assert_close(advantages(rewards, alive), torch.tensor(want).double())


def test_first_order_gradients_without_noise_are_those_of_every_member() -> None:
    task = make_task("CopterHover", seconds=0.2)
    net = first_controller(task, 0, 10)
    weights = {k: p.detach() for k, p in net.named_parameters()}
    start = task.start(3, np.random.default_rng(0))
    _, first, _ = both_gradients(task, net, start, torch.zeros(5, 3, 4).double(), 0.1)
    torch.testing.assert_close(first, _per_episode(task, net, weights, 5, 3, 0))


TINY = Setup("CopterHover", {"seconds": 0.2}, evaluation_episodes=2, warm_up=5)


def gradient_of(made: MixedLearner) -> Tensor:
    """Of the mean reward, as it was left in the network."""
    made._differentiate(made.task.start(4, made.rng), 5)
    return -torch.cat([p.grad.flatten() for p in made.net.parameters() if p.grad is not None])


def test_an_episode_without_first_order_gradient_counts_with_its_zeroth_order_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kept: list[Any] = []

    def breaking(*args: Any) -> Any:
        episode, first, zeroth = both_gradients(*args)
        first[1, 7] = math.nan
        kept[:] = [first.clone(), zeroth.clone()]
        return episode, first, zeroth

    monkeypatch.setattr(mixed, "both_gradients", breaking)
    made = MixedLearner(TINY, MixedOptions(batch=4))
    got = gradient_of(made)
    first, zeroth = kept
    first[1] = zeroth[1]
    alpha = first_order_weight(first, zeroth, 0.95)
    assert 0.0 < alpha < 1.0
    torch.testing.assert_close(got, (alpha * first + (1.0 - alpha) * zeroth).mean(0))
    scalars = made.update(0.0).scalars
    assert scalars["train/broken_episodes"] == 1.0 and scalars["train/bad_updates"] == 0.0
    assert scalars["train/alpha"] < 0.75


@pytest.mark.parametrize(("weighing", "index"), [("first_order", 1), ("zeroth_order", 2)])
def test_controls_take_one_of_both_gradients_alone(
    monkeypatch: pytest.MonkeyPatch, weighing: str, index: int
) -> None:
    kept: list[Tensor] = []

    def record(*args: Any) -> Any:
        found = both_gradients(*args)
        kept.append(found[index].mean(0))
        return found

    monkeypatch.setattr(mixed, "both_gradients", record)
    got = gradient_of(MixedLearner(TINY, MixedOptions(batch=4, weighing=weighing)))
    torch.testing.assert_close(got, kept[0])


class Refusing(torch.autograd.Function):
    """An adjoint that refuses what it is given."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return x.clone()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        raise ValueError("gradient must be finite, got 3 NaN or infinite entries")


def test_a_batch_whose_adjoint_breaks_down_learns_by_sampling() -> None:
    net = small_net()
    sound = Toy(lambda x, a: x + a, lambda x: -x * x, 3)
    broken = Toy(lambda x, a: Refusing.apply(x + a), lambda x: -x * x, 3)
    first, zeroth = sample(broken, net, 8, 0)
    assert bool(first.isnan().all())
    torch.testing.assert_close(zeroth, sample(sound, net, 8, 0)[1])


def test_gradients_of_episodes_are_sums_over_their_steps() -> None:
    net, rng = small_net(), np.random.default_rng(0)
    seen, pull = (torch.from_numpy(rng.standard_normal((5, 3, 1))) for _ in range(2))
    (got,) = episode_gradients(net, seen, pull)
    for k in range(3):
        want = torch.autograd.grad((net(seen[:, k]) * pull[:, k]).sum(), list(net.parameters()))
        torch.testing.assert_close(got[k], torch.cat([g.flatten() for g in want]))


def test_an_unknown_way_of_weighing_is_refused() -> None:
    with pytest.raises(ValueError, match="weighing must be one of"):
        make_learner("mixed", TINY, {"weighing": "second_order"})


def test_it_learns_on_the_quick_preset() -> None:
    plan = presets.preset("quick")["CopterHover"]
    made: Any = make_learner("mixed", plan.run_setup("mixed", 0), plan.candidates["mixed"][1])
    before, spent = evaluate(made.task, made.net, 16), 0
    while spent < plan.steps["mixed"]:
        spent += made.update(spent / plan.steps["mixed"]).steps
    assert evaluate(made.task, made.net, 16) > before
