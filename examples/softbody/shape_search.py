"""Searches over numbers in [-1, 1] for the largest gain: what examples of shape share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from diffsim import optim
from diffsim.core import DiffsimError, MeshError

Gain = Callable[[Tensor], Tensor]  # of numbers (n,)
FAILURES = (MeshError, DiffsimError)  # no mesh, or no solution


def by_lbfgs(gain: Gain, start: np.ndarray, evaluations: int) -> np.ndarray:
    """Numbers (n,) found by L-BFGS, where steps to what fails are shortened."""

    def loss(x: np.ndarray) -> tuple[float, np.ndarray]:
        leaf = torch.tensor(x, requires_grad=True)
        value = gain(leaf)
        (slope,) = torch.autograd.grad(-value, leaf)
        return -value.item(), slope.numpy()

    bounds = (-np.ones(start.size), np.ones(start.size))
    options = optim.Options(
        budget=optim.Budget(evaluations=evaluations), wall=optim.Wall(failures=FAILURES)
    )
    return optim.minimize(loss, start, bounds, options).x


def by_adam(gain: Gain, start: np.ndarray, evaluations: int, rate: float = 0.05) -> np.ndarray:
    """Numbers (n,) found by Adam at a rate that falls to zero: the best that it met."""
    leaf = torch.tensor(start, requires_grad=True)
    optimizer = torch.optim.Adam([leaf], lr=rate)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, evaluations)
    best, found = -np.inf, start
    for _ in range(evaluations):
        value = gain(leaf)
        if value.item() > best:
            best, found = value.item(), leaf.detach().numpy().copy()
        optimizer.zero_grad()
        (-value).backward()
        optimizer.step()
        schedule.step()
        with torch.no_grad():
            leaf.clamp_(-1.0, 1.0)
    return found


def by_evolution(gain: Gain, start: np.ndarray, evaluations: int, seed: int) -> np.ndarray:
    """Numbers (n,) found by CMA-ES within the same bounds."""
    import cma

    def loss(x: np.ndarray) -> float:
        with torch.no_grad():
            try:
                return -gain(torch.from_numpy(x)).item()
            except FAILURES:
                return np.inf

    options = {"bounds": [-1, 1], "seed": seed + 1, "maxfevals": evaluations, "verbose": -9}
    return cma.fmin2(loss, start, 0.3, options)[0]
