"""Soft analytic policy optimization: entropy, its price, soft targets, two critics, learning."""

import copy
import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("gymnasium", reason="environments need gymnasium: pip install '.[rl]'")

from diffsim.control import MLPController
from diffsim.learn.critics import Critics
from diffsim.learn.explorer import normal_entropy
from diffsim.learn.sapo import (
    SapoLearner,
    SapoOptions,
    SoftExplorer,
    Temperature,
    log_slope,
    scaled_entropy,
)
from diffsim.learn.setup import Setup, evaluate, first_controller
from diffsim.learn.short_horizon import WindowRecord
from tests.optional import needs

needs("tensorboard", reason="training writes a TensorBoard log")


TINY = Setup("CopterHover", {"seconds": 0.2}, warm_up=5)
SMALL: dict[str, Any] = {"batch": 2, "window": 2, "discount": 0.9}


def made(**options: Any) -> SapoLearner:
    """A small one."""
    return SapoLearner(TINY, SapoOptions(**(SMALL | options)))


def explorer(**options: Any) -> tuple[SoftExplorer, MLPController]:
    """With the controller that it explores about."""
    task = TINY.make_task()
    return SoftExplorer(task, SapoOptions(**options), 7), first_controller(task, 0, 5)


def seen(rows: int) -> tuple[Tensor, Tensor]:
    """Observations and noise."""
    rng = np.random.default_rng(0)
    x, noise = rng.standard_normal((rows, 22)), rng.standard_normal((rows, 4))
    return torch.from_numpy(x), torch.from_numpy(noise)


def test_entropy_of_a_normal_distribution_is_torch_s() -> None:
    log_spread = torch.tensor([[-1.0, 0.3], [0.2, -2.0]]).double()
    want = torch.distributions.Normal(torch.zeros(2, 2).double(), log_spread.exp()).entropy()
    torch.testing.assert_close(normal_entropy(log_spread), want.sum(-1))


def test_entropy_of_bounded_commands_is_minus_their_mean_log_density() -> None:
    made_, net = explorer(exploration=0.8)
    x = seen(1)[0]
    noise = torch.from_numpy(np.random.default_rng(1).standard_normal((40_000, 4)))
    with torch.no_grad():
        commands, entropy = made_.draw(net, x.expand(len(noise), -1), noise)
        normalized = net.normalizer(x)  # type: ignore[misc]
        base = torch.distributions.Normal(
            net.layers[:-1](normalized), made_.log_spread(normalized).exp()
        )
        squashed = torch.distributions.TransformedDistribution(
            base, torch.distributions.TanhTransform()
        )
        sampled = -squashed.log_prob(commands).sum(-1)
    spread = float((sampled - entropy).std()) / math.sqrt(len(noise))
    assert float(entropy.mean()) == pytest.approx(float(sampled.mean()), abs=5 * spread)
    assert spread < 0.01
    assert float(commands.abs().max()) <= 1.0


def test_the_slope_of_a_far_tanh_keeps_its_logarithm() -> None:
    u = torch.tensor([0.0, 0.7, -3.0, 40.0, -40.0]).double()
    want = torch.tensor([0.0, *(math.log(1 - math.tanh(x) ** 2) for x in (0.7, -3.0))]).double()
    torch.testing.assert_close(log_slope(u)[:3], want)
    # 1 - tanh^2 -> 4 exp(-2 |u|)
    torch.testing.assert_close(log_slope(u)[3:], torch.full((2,), math.log(4.0) - 80.0).double())


def test_the_gradient_of_the_bonus_agrees_with_finite_differences() -> None:
    made_, net = explorer(exploration=0.5, temperature=0.3)
    x, noise = seen(6)

    def bonus() -> Tensor:
        return made_.bonus(made_.draw(net, x, noise)[1]).mean()

    parts = [*net.parameters(), *made_.parameters()]
    rng = np.random.default_rng(3)
    along = [torch.from_numpy(rng.standard_normal(tuple(p.shape))) for p in parts]
    got = sum(
        float((g * d).sum())
        for g, d in zip(torch.autograd.grad(bonus(), parts), along, strict=True)
    )

    def moved(step: float) -> float:
        with torch.no_grad():
            for p, d in zip(parts, along, strict=True):
                p.add_(d, alpha=step)
            value = float(bonus())
            for p, d in zip(parts, along, strict=True):
                p.sub_(d, alpha=step)
        return value

    h = 1e-5
    assert abs(got) > 1e-3
    assert got == pytest.approx((moved(h) - moved(-h)) / (2 * h), rel=1e-6)


def test_the_bonus_is_nothing_at_the_wanted_entropy_and_its_slope_is_the_price() -> None:
    entropy = torch.tensor([-2.0, 0.0, -6.0]).double()
    torch.testing.assert_close(
        scaled_entropy(entropy, -2.0), torch.tensor([0.0, 0.5, -1.0]).double()
    )
    made_, _ = explorer(temperature=0.4)  # four commands at -1/2
    torch.testing.assert_close(made_.bonus(entropy), torch.tensor([0.0, 0.2, -0.4]).double())


def test_the_spread_depends_on_the_state_and_the_controller_is_untouched_by_it() -> None:
    made_, net = explorer()
    x, _ = seen(2)
    none = torch.zeros(2, 4).double()
    torch.testing.assert_close(made_.draw(net, x, none)[0], net(x))
    with torch.no_grad():
        made_.log_spread[-1].weight.mul_(100.0)
    one = none + 1.0
    spread = torch.atanh(made_.draw(net, x, one)[0]) - torch.atanh(net(x))
    assert float((spread[0] / spread[1] - 1.0).abs().min().detach()) > 1e-3


@pytest.mark.parametrize(("entropy", "sign"), [(-1.0, -1.0), (-3.0, 1.0)])
def test_the_price_falls_above_the_wanted_entropy_and_rises_below(
    entropy: float, sign: float
) -> None:
    price = Temperature(0.1, 1e-2, -2.0)
    price.adapt(torch.full((3, 2), entropy).double())
    assert sign * math.log(price.value / 0.1) == pytest.approx(1e-2, rel=1e-6)  # Adam's first step


def test_the_price_brings_the_entropy_to_the_wanted_one() -> None:
    # noise of spread sigma costs 3 sigma a command: the best is alpha / (3 * 2 |T|), which the
    # actor has at once here (two optimizers of equal pace swing)
    price = Temperature(0.3, 2e-3, -1.0)
    for _ in range(2_000):
        log_spread = torch.full((2,), math.log(price.value / 6.0), dtype=torch.float64)
        log_spread.requires_grad_()
        entropy = normal_entropy(log_spread)
        cost = 3.0 * log_spread.exp().sum() - price.value * scaled_entropy(entropy, -1.0)
        (slope,) = torch.autograd.grad(cost, log_spread)
        assert float(slope.abs().max()) < 1e-9
        price.adapt(entropy)
    assert float(entropy.detach()) == pytest.approx(-1.0, abs=0.02)
    sigma = math.exp(-0.5) / math.sqrt(2.0 * math.pi * math.e)  # of entropy -1/2
    assert price.value == pytest.approx(6.0 * sigma, rel=0.05)


def test_soft_targets_agree_with_a_hand_computed_case() -> None:
    learner = made(trace=0.5, temperature=0.4)
    # entropies above, at and below the wanted -2 are worth 0.1, 0 and -0.1
    window = WindowRecord(
        normalized=torch.zeros(2, 2, 22).double(),
        rewards=torch.tensor([[1.0, 1.0], [2.0, 2.0]]).double(),
        entropy=torch.tensor([[-1.0, -3.0], [-2.0, -1.0]]).double(),
        next_values=torch.tensor([[10.0, 10.0], [20.0, 20.0]]).double(),
        failed=torch.tensor([[False, False], [False, True]]),
        ended=torch.tensor([[False, False], [False, True]]),
    )
    last = [2.0 + 0.9 * 20.0, 2.1]
    first = [1.1 + 0.9 * (5.0 + 0.5 * last[0]), 0.9 + 0.9 * (5.0 + 0.5 * last[1])]
    torch.testing.assert_close(learner._goals(window), torch.tensor([first, last]).double())


def test_a_window_pays_entropy_and_the_mean_of_the_critics_and_learns_from_the_lowest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    learner = made(temperature=0.4)
    learner.state["step"].zero_()
    for critic, value in zip(learner.critics.targets, (7.0, 9.0), strict=True):
        monkeypatch.setattr(critic, "forward", lambda x, value=value: 0.0 * x[:, 0] + value)
    monkeypatch.setattr(
        learner.task, "step", lambda s, a: (s | {"step": s["step"] + 1}, 0.0 * a[:, 0] + 1.0)
    )
    monkeypatch.setattr(learner.task, "failed", lambda s: torch.tensor([False, False]))
    loss, window = learner._window()
    paid = 1.0 + 0.4 * (window.entropy.numpy() + 2.0) / 4.0
    total = paid[0] + 0.9 * paid[1] + 0.81 * 8.0
    assert float(loss.detach()) == pytest.approx(-float(total.mean()) / 2)
    assert window.next_values.eq(7.0).all() and window.rewards.eq(1.0).all()
    assert float(np.abs(paid - 1.0).min()) > 1e-4  # the bonus is in what was compared


def test_two_critics_differ_and_both_learn() -> None:
    critics = Critics(3, 0.9, 0, 2)
    rng = np.random.default_rng(0)
    x = torch.from_numpy(rng.standard_normal((64, 3)))
    goals = x[:, 0] + 2.0
    before = [(c(x) - goals).square().mean().item() for c in critics.members]
    assert before[0] != before[1]
    adam = torch.optim.Adam(critics.members.parameters(), lr=1e-2)
    critics.fit(adam, x, goals, rng, passes=40, parts=2, clip=1.0)
    for critic, first in zip(critics.members, before, strict=True):
        assert float((critic(x) - goals).square().mean().detach()) < 0.05 * first
    critics.follow(0.0)  # no target critics
    mean, lowest = critics.values(x)
    each = torch.stack([c(x) for c in critics.members]).detach()
    torch.testing.assert_close(mean, each.mean(0))
    torch.testing.assert_close(lowest, each.min(0).values)


def test_a_checkpoint_holds_the_price_of_entropy() -> None:
    learner, again = made(), made()
    for _ in range(2):
        learner.update(0.0)
    again.load_state_dict(copy.deepcopy(learner.state_dict()))
    for one in (learner, again):
        one.update(0.5)
    prices = [one.explorer.scalars()["train/temperature"] for one in (learner, again)]
    assert prices[0] == prices[1] != SapoOptions().temperature


@pytest.mark.story  # training
def test_a_short_training_hovers_better() -> None:
    setup = Setup("CopterHover", warm_up=20)
    learner = SapoLearner(setup, SapoOptions(batch=64, window=32, actor_rate=1e-2))
    before = evaluate(learner.task, learner.net, 4)
    for k in range(10):
        learner.update(k / 10)
    gain = evaluate(learner.task, learner.net, 4) - before
    assert gain > 0.3 * (1.0 - before)
