"""Are a task's gradients any good? Analytic against sampled ones, explosions, contact.

The analytic gradient of an episode may be right and yet useless: in chaotic or contact-rich
dynamics it grows without bound with the horizon and says nothing about a step of finite length
(Suh et al., "Do differentiable simulators give better policy gradients?", 2022).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from diffsim.envs.rollout import Controller, rollout_task
from diffsim.envs.task import Task
from diffsim.learn.cma_es import steer_members

Parameters = dict[str, Tensor]


@dataclass(frozen=True)
class GradientQuality:
    """At one horizon."""

    horizon: int  # steps
    # cosine of the analytic and the zeroth-order gradient, within random directions; 1 at best
    cosine: float
    norm_ratio: float  # ratio of their norms there, analytic over zeroth-order; 1 at best
    norm: float  # norm of the analytic gradient of the mean reward, median over episodes
    # share of episodes whose gradient is not finite or more than 100 times longer than the median
    # one
    explosion_rate: float
    contact_share: float  # share of steps in which the robot touches something


def gradient_quality(
    task: Task,
    controller: nn.Module,
    horizons: Sequence[int],
    *,
    episodes: int = 4,
    directions: int = 32,
    spread: float = 0.02,
    seed: int = 0,
) -> list[dict[str, Any]]:
    """Compare gradients of the mean reward at several horizons.

    The zeroth-order gradient is sampled within random orthonormal directions of the parameters, by
    antithetic differences of length ``spread`` times the root mean square of the parameters times
    the root of their number: long enough to see what a step of training would.

    Args:
        task: The task to be controlled.
        controller: Where gradients are compared.
        horizons: Steps.
        episodes: Starts; the same for both gradients.
        directions: Two episodes each per start.
        spread: Relative length of a difference.
        seed: Seed of starts and directions.

    Returns:
        One ``GradientQuality`` per horizon, as dicts.
    """
    parameters = {k: p.detach() for k, p in controller.named_parameters()}
    flat = torch.cat([p.flatten() for p in parameters.values()])
    rng = np.random.default_rng(seed)
    draws = torch.from_numpy(rng.standard_normal((len(flat), directions)))
    basis = torch.linalg.qr(draws).Q.mT  # (directions, parameters)
    length = spread * float(flat.norm())
    all_sampled = _sample_gradients(
        task, controller, parameters, basis, length, horizons, episodes, seed
    )
    rows = []
    for horizon, sampled in zip(horizons, all_sampled, strict=True):
        analytic = _per_episode(task, controller, parameters, horizon, episodes, seed)
        within = analytic.mean(0) @ basis.mT
        norms = analytic.norm(dim=1)
        finite = norms[torch.isfinite(norms)]
        middle = float(finite.median()) if len(finite) else float("nan")
        wild = ~torch.isfinite(norms) | (norms > 100.0 * middle)
        quality = GradientQuality(
            horizon=horizon,
            cosine=float(torch.cosine_similarity(within, sampled, dim=0)),
            norm_ratio=float(within.norm() / sampled.norm()),
            norm=middle,
            explosion_rate=float(wild.double().mean()),
            contact_share=contact_share(task, controller, horizon, episodes, seed),
        )
        rows.append(asdict(quality))
    return rows


def contact_share(
    task: Task, controller: Controller, horizon: int, episodes: int, seed: int
) -> float:
    """Share of steps with a contact force; 0 for tasks without contact."""
    state = task.start(episodes, np.random.default_rng(seed))
    if "contact_force" not in state:
        return 0.0
    touching = []
    with torch.no_grad():
        for k in range(horizon):
            state, _ = task.step(state, controller(task.observe(state), k))
            touching.append((state["contact_force"].abs().flatten(1).amax(1) > 0.0).double())
    return float(torch.stack(touching).mean())


def _per_episode(
    task: Task,
    controller: nn.Module,
    parameters: Parameters,
    horizon: int,
    episodes: int,
    seed: int,
) -> Tensor:
    """Gradient of every episode's mean reward, (episodes, parameters)."""
    leaves = {
        k: p.expand(episodes, *p.shape).clone().requires_grad_() for k, p in parameters.items()
    }
    start = task.start(episodes, np.random.default_rng(seed))
    rewards = rollout_task(task, steer_members(controller, leaves), start, horizon).rewards
    grads = torch.autograd.grad(rewards.mean(0).sum(), list(leaves.values()))
    return torch.cat([g.flatten(1) for g in grads], 1)


def _sample_gradients(
    task: Task,
    controller: nn.Module,
    parameters: Parameters,
    basis: Tensor,
    length: float,
    horizons: Sequence[int],
    episodes: int,
    seed: int,
) -> Tensor:
    """Zeroth-order gradients within the basis, (horizons, directions), from one longest rollout."""
    moves = torch.cat([length * basis, -length * basis]).repeat_interleave(episodes, 0)
    weights, place = {}, 0
    for name, p in parameters.items():
        part = moves[:, place : place + p.numel()].reshape(-1, *p.shape)
        weights[name], place = p + part, place + p.numel()
    start = task.start(episodes, np.random.default_rng(seed))
    many = {k: v.repeat(2 * len(basis), *(1,) * (v.dim() - 1)) for k, v in start.items()}
    with torch.no_grad():
        rewards = rollout_task(
            task, steer_members(controller, weights), many, max(horizons)
        ).rewards
    out = []
    for horizon in horizons:
        mean = rewards[:horizon].mean(0).reshape(2, len(basis), episodes).mean(2)
        out.append((mean[0] - mean[1]) / (2.0 * length))
    return torch.stack(out)
