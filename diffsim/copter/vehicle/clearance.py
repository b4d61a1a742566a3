"""Clearance between propeller discs, differentiable in the design (thesis 3.4, future work)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffsim.copter.vehicle.multicopter import Multicopter
from diffsim.core.checked import checked
from diffsim.core.errors import ConvergenceError
from diffsim.core.numbers import to_numpy

_TOUCH = 1e-9  # distance, in radii, below which discs count as cutting each other
_MAX_ITERS = 20000


@checked
def disc_clearances(copter: Multicopter) -> Tensor:
    """Shortest distance between the discs of every two propellers.

    Args:
        copter: The vehicle; the discs stand at ``positions``, normal to ``directions``, with
            ``radii``.

    Returns:
        (n_pairs,) [m], pairs in the order of ``torch.triu_indices(n, n, 1)``. Where two discs cut
        each other it is the distance of their centers less both radii, negative; for discs in one
        plane that goes on smoothly from a touch, for others it jumps down.

    Raises:
        ConvergenceError: a distance did not converge to 1e-9 radii.

    Gradients: positions, directions, radii.
    """
    i, j = torch.triu_indices(copter.num_rotors, copter.num_rotors, 1)
    first = copter.positions[i], copter.directions[i], copter.radii[i]
    second = copter.positions[j], copter.directions[j], copter.radii[j]
    between = torch.linalg.vector_norm(first[0] - second[0], dim=-1)
    if len(i) == 0:
        return between
    discs = [tuple(to_numpy("copter", t) for t in disc) for disc in (first, second)]
    p, q = _closest_points(*discs[0], *discs[1])
    # The closest points, as material points of their discs, move with the design; that they also
    # slide does not change the distance to first order.
    gap = _material(p, *first) - _material(q, *second)
    size = np.linalg.norm(p - q, axis=-1)
    apart = torch.from_numpy(size > _TOUCH * (discs[0][2] + discs[1][2]))
    safe = torch.where(apart[:, None], gap, torch.ones_like(gap))
    distance = torch.linalg.vector_norm(safe, dim=-1)
    return torch.where(apart, distance, between - first[2] - second[2])


@checked
def min_clearance(copter: Multicopter) -> Tensor:
    """The smallest of ``disc_clearances``, () [m]; infinite for one propeller."""
    clearances = disc_clearances(copter)
    if clearances.numel() == 0:
        return torch.full((), torch.inf, dtype=torch.float64)
    return clearances.min()


def _material(p: np.ndarray, center: Tensor, normal: Tensor, radius: Tensor) -> Tensor:
    """The point of a disc that is at p now, carried along by center, turn and radius."""
    arm = torch.from_numpy(p) - center.detach()
    axis = normal.detach()
    # To first order the turn of the disc maps arm to arm - axis (dn . arm).
    turned = arm - axis * ((normal - axis) * arm).sum(-1, keepdim=True)
    held = radius.detach()
    share = torch.where(held > 0.0, radius / held.clamp_min(1e-300), 1.0)
    return center + share[:, None] * turned


def _closest_points(
    c1: np.ndarray, n1: np.ndarray, r1: np.ndarray, c2: np.ndarray, n2: np.ndarray, r2: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Closest points of pairs of discs: accelerated projected gradient on half the squared gap.

    The Hessian of |p - q|^2 / 2 in (p, q) has norm 2, so 1/2 is the step; momentum restarts where
    it points uphill.
    """
    p, q = c1.copy(), c2.copy()
    p_old, q_old, momentum = p, q, np.zeros(len(p))
    scale = np.maximum(r1 + r2, 1e-300)
    for _ in range(_MAX_ITERS):
        beta = (momentum / (momentum + 3.0))[:, None]
        ps, qs = p + beta * (p - p_old), q + beta * (q - q_old)
        gap = ps - qs
        p_new = _project(ps - 0.5 * gap, c1, n1, r1)
        q_new = _project(qs + 0.5 * gap, c2, n2, r2)
        uphill = ((ps - p_new) * (p_new - p) + (qs - q_new) * (q_new - q)).sum(-1) > 0.0
        momentum = np.where(uphill, 0.0, momentum + 1.0)
        step = np.maximum(np.abs(p_new - ps).max(-1), np.abs(q_new - qs).max(-1))
        p_old, q_old, p, q = p, q, p_new, q_new
        if float((step / scale).max()) < 1e-13:
            return p, q
    gap = p - q
    # Optimality: no point of a disc lies further along the gap than the closest one.
    slack = _beyond(-gap, p, c1, n1, r1) + _beyond(gap, q, c2, n2, r2)
    size = np.linalg.norm(gap, axis=-1)
    error = float((slack / np.maximum(size, _TOUCH * scale) / scale).max())
    if error > 1e-9:
        raise ConvergenceError(
            f"closest points of two propeller discs converged to {error:.1e} radii only",
            residual_norm=error,
            tolerance=1e-9,
            num_iters=_MAX_ITERS,
        )
    return p, q


def _project(x: np.ndarray, c: np.ndarray, n: np.ndarray, r: np.ndarray) -> np.ndarray:
    arm = x - c
    arm = arm - n * (arm * n).sum(-1, keepdims=True)
    length = np.linalg.norm(arm, axis=-1)
    return c + arm * np.minimum(1.0, r / np.maximum(length, 1e-300))[:, None]


def _beyond(
    g: np.ndarray, p: np.ndarray, c: np.ndarray, n: np.ndarray, r: np.ndarray
) -> np.ndarray:
    """How much further along g the disc reaches than p."""
    flat = g - n * (g * n).sum(-1, keepdims=True)
    return r * np.linalg.norm(flat, axis=-1) - (g * (p - c)).sum(-1)
