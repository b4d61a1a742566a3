"""Adam on an inverse-variance mix of gradients through the simulator and sampled ones.

Suh, Simchowitz, Zhang, Tedrake, "Do differentiable simulators give better policy gradients?", ICML
2022: the alpha-order batched gradient. Parmas, Rasmussen, Peters, Doya, "PIPPS", ICML 2018, mixes
the same two estimators step by step.

Commands get Gaussian noise e_t of standard deviation s. Both gradients of an episode's reward R
are then sums over its steps, J_t^T c_t, J_t being the network's derivative at what is seen then:

- first order: c_t = dR/de_t through the simulator, which includes all that follows from e_t;
- zeroth order: c_t = e_t / s^2 (rewards to go - baseline), Williams, "Simple statistical
  gradient-following algorithms", 1992, eq. 11.

So one backward pass through the simulator, to the noise, gives the first-order gradients of all
episodes one by one; the network's J_t^T costs no simulation.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.func import functional_call, vjp, vmap

from diffsim.core.check import require_choice, require_number
from diffsim.core.checked import checked
from diffsim.envs.rollout import Episode, rollout_task
from diffsim.envs.task import Task, TaskState
from diffsim.learn.gradient import GradientLearner, GradientOptions
from diffsim.learn.parallel import Batch
from diffsim.learn.setup import Setup, broke_down

FIXED_WEIGHTS = {"first_order": 1.0, "zeroth_order": 0.0}


@checked
@dataclass(frozen=True)
class MixedOptions(GradientOptions):
    """Options of ``MixedLearner``; besides those of ``GradientOptions``.

    Attributes:
        batch: Episodes per update, at least 2: variances are over episodes.
        spread: Standard deviation of the noise on commands.
        confidence: Confidence of the bound on the zeroth-order gradient's error. The bound keeps a
            biased first-order gradient in check; 1: no check.
        weighing: "variance"; or one of both alone, as a control: "first_order" (Adam with noise on
            the commands) or "zeroth_order" (no gradient through the simulator, but its price).
    """

    batch: int = 16
    spread: float = 0.1
    confidence: float = 0.95
    weighing: str = "variance"

    def __post_init__(self) -> None:
        require_number("batch", self.batch, at_least=2, hint="variances are over episodes")
        require_number("spread", self.spread, above=0.0)
        require_number("confidence", self.confidence, at_least=0.0, at_most=1.0)
        require_choice("weighing", self.weighing, ("variance", *FIXED_WEIGHTS))


def advantages(rewards: Tensor, alive: Tensor) -> Tensor:
    """Rewards to go, less the mean of those of the other episodes that still go on.

    A step's noise has no effect on earlier rewards nor on other episodes, so that neither leaving
    the former out nor subtracting the latter changes the mean of the zeroth-order gradient.

    Args:
        rewards: (steps, batch).
        alive: (steps, batch) bool: not failed before the step.

    Returns:
        (steps, batch); 0 after a failure, and the mere rewards to go of the last one alive.
    """
    to_go = rewards.flip(0).cumsum(0).flip(0) * alive
    others = (alive.sum(1, keepdim=True) - 1).clamp(min=1)
    baseline = (to_go.sum(1, keepdim=True) - to_go) / others
    return (to_go - baseline) * alive


def both_gradients(
    task: Task,
    net: nn.Module,
    start: TaskState,
    noise: Tensor,
    spread: float,
    cut_every: int | None = None,
) -> tuple[Episode, Tensor, Tensor]:
    """Both gradients of every episode's mean reward, from one rollout.

    Args:
        task, net, start: Who steers what from where.
        noise: On commands, (steps, batch, num_actions).
        spread: Standard deviation of the noise.
        cut_every: The same as for ``rollout_task``; biases the first-order gradient.

    Returns:
        The episode; first order, (batch, parameters), NaN where the simulator's adjoint breaks
        down; zeroth order likewise.
    """
    noise = noise.clone().requires_grad_()
    episode = rollout_task(
        task, lambda seen, k: net(seen, k) + noise[k], start, len(noise), cut_every=cut_every
    )
    try:
        (through,) = torch.autograd.grad(episode.rewards.mean(0).sum(), noise)
    except (ArithmeticError, RuntimeError, ValueError) as error:
        if not broke_down(error):
            raise
        through = torch.full_like(noise, float("nan"))
    gains = advantages(episode.rewards.detach(), episode.alive) / len(noise)
    sampled = noise.detach() / spread**2 * gains[..., None]
    first, zeroth = episode_gradients(net, episode.observations, through, sampled)
    return episode, first, zeroth


def episode_gradients(net: nn.Module, seen: Tensor, *cotangents: Tensor) -> list[Tensor]:
    """Sum over steps of J_t^T c_t for every episode.

    Args:
        net: Network of the commands; its parameters are those differentiated for.
        seen: (steps, batch, num_observations).
        *cotangents: (steps, batch, num_actions) each.

    Returns:
        (batch, parameters) for each of the cotangents.
    """
    weights = {name: p.detach() for name, p in net.named_parameters()}

    def one(rows: Tensor, *pulls: Tensor) -> list[Tensor]:
        pull = vjp(lambda w: functional_call(net, w, (rows,)), weights)[1]
        return [torch.cat([g.flatten() for g in pull(c)[0].values()]) for c in pulls]

    out: list[Tensor] = vmap(one, in_dims=1)(seen, *cotangents)
    return out


def first_order_weight(first: Tensor, zeroth: Tensor, confidence: float) -> float:
    """Weight alpha of the first-order gradient.

    alpha = var0 / (var0 + var1), the traces of the covariances over episodes: least variance (Suh
    et al. 2022, section 4). One weight for all parameters, as there: the variances of a few
    episodes are noisy themselves, and a weight that follows its own gradient's noise biases it.

    A first-order gradient may be wrong and yet vary little (of a step function it is zero). As in
    the paper, eps + alpha B <= gamma then bounds the error of the mix: B is the distance of both
    means, eps bounds the error of the zeroth-order one. Two things differ. eps is Chebyshev's,
    sqrt(var0 / (n (1 - confidence))): the paper's Bernstein bound asks for a largest sample, which
    Gaussian noise does not have. And gamma is 2 eps, not a length to be tuned for every task. So
    alpha <= eps / B, which binds where both differ by more than chance explains.

    Args:
        first, zeroth: (episodes, parameters), finite.
        confidence: See ``MixedOptions``.

    Returns:
        In [0, 1]; 1 where neither varies and both agree, 0 where var1 overflows.
    """
    n = len(first)
    var1, var0 = (float(g.var(0).sum()) for g in (first, zeroth))
    if not var1 < float("inf"):  # nan of a mean that overflows, too
        return 0.0
    alpha = 1.0 if var0 + var1 == 0.0 else var0 / (var0 + var1)
    apart = float((first.mean(0) - zeroth.mean(0)).norm())
    if confidence == 1.0 or apart == 0.0:
        return alpha
    bound = (var0 / (n * (1.0 - confidence))) ** 0.5
    return min(alpha, bound / apart)


class MixedLearner(GradientLearner):
    """Adam on the mean reward of whole episodes with noise on the commands.

    An episode whose first-order gradient is not finite counts with its zeroth-order one alone.
    Every step is simulated once and differentiated once, as in ``GradientLearner``.

    Args:
        setup: Task and seed.
        options: Options of the method.
    """

    options: MixedOptions

    @checked
    def __init__(self, setup: Setup, options: MixedOptions | None = None):
        super().__init__(setup, options or MixedOptions())

    def _differentiate(self, start: TaskState, horizon: int) -> Batch:
        """A batch of episodes with its mixed gradient."""
        o = self.options
        draws = self.rng.standard_normal((horizon, o.batch, self.task.num_actions))
        noise = o.spread * torch.from_numpy(draws)
        cut = o.cut_every or None
        episode, first, zeroth = both_gradients(self.task, self.net, start, noise, o.spread, cut)
        broken = ~torch.isfinite(first).all(1)
        first = torch.where(broken[:, None], zeroth, first)
        alpha = FIXED_WEIGHTS.get(o.weighing)
        if alpha is None:
            alpha = first_order_weight(first, zeroth, o.confidence)
        mean = torch.lerp(zeroth.mean(0), first.mean(0), alpha)
        sizes = [p.numel() for p in self.net.parameters()]
        for p, part in zip(self.net.parameters(), mean.split(sizes), strict=True):
            p.grad = -part.view_as(p)
        scalars = {
            "train/alpha": alpha * float((~broken).double().mean()),
            "train/broken_episodes": float(broken.sum()),
        }
        reward = episode.rewards.detach().mean()
        return Batch(reward, episode.observations[episode.alive], scalars)
