"""Away from shapes that no thrusts can control, such as rotors in a line."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import LinearConstraint, minimize

from diffsim.copter.codesign.polytope import random_feasible
from diffsim.core.arrays import Array

if TYPE_CHECKING:
    from diffsim.copter.codesign.task import Point, Task


CONTROLLABLE = 1e-4  # margin below which a design counts as lost
_FLOOR = 1e-8  # keeps the barrier finite where control is lost
_PULL = 1.0  # of the start, against growing the barrier's gain without end


def effectiveness(task: Task, s: Array, d: Array, spins: Array) -> tuple[Array, Array]:
    """Thrusts to lift and torque (4, n_rotors), relative, and its derivative by z (4, n, p)."""
    shape, rotors = task.model.at(s), task.rotors
    reaction = spins * task.model.vehicle.torque_ratios.numpy()
    torque = np.cross(shape.positions, d) + reaction[:, None] * d
    unit = rotors.max_thrusts / rotors.weight
    matrix = np.vstack([-d[:, 2] * unit, torque.T * unit / rotors.length])
    moved = np.cross(shape.d_positions, d[..., None], axisa=1, axisb=1, axisc=1)  # (n, 3, p)
    slope = np.zeros((4, len(d), task.model.num_params))
    slope[1:] = moved.transpose(1, 0, 2) * unit[None, :, None]
    return matrix, slope


def control_margin(task: Task, point: Point, spins: Array) -> float:
    """Least singular value of thrusts to lift and torques over the largest; 0: not controllable."""
    matrix, _ = effectiveness(task, point.s, point.d, spins)
    if min(matrix.shape) < 4:
        return 0.0
    singular = np.linalg.svd(matrix, compute_uv=False)
    return float(singular[-1] / singular[0])


def barrier(
    task: Task, point: Point, spins: Array, step: Array, origin: Array
) -> tuple[float, Array]:
    """-log det(M M' + floor) + pull |step - origin|^2 / 2 and its gradient by the step z."""
    s = task.model.start + task.model.length * step
    matrix, slope = effectiveness(task, s, point.d, spins)
    gram = matrix @ matrix.T + _FLOOR * np.eye(4)
    inverse = np.linalg.inv(gram)
    gradient = -2.0 * np.einsum("ai,aip->p", inverse @ matrix, slope) + _PULL * (step - origin)
    value = -np.linalg.slogdet(gram)[1] + 0.5 * _PULL * ((step - origin) ** 2).sum()
    return float(value), gradient


def move_to_controllable(task: Task, point: Point, rng: np.random.Generator) -> tuple[Point, float]:
    """Move the shape until thrusts span lift and all three torques.

    The barrier is flat at a symmetric start, so the search begins beside it.

    Returns:
        The point with its new shape, and the least singular value of M there over the largest.
    """
    model, spins = task.model, np.array([(-1.0) ** i for i in range(task.model.num_rotors)])
    s = random_feasible(model.A, model.b, point.s, 0.3 * model.length, rng)
    origin = (s - model.start) / model.length
    solution = minimize(
        lambda step: barrier(task, point, spins, step, origin),
        origin,
        jac=True,
        method="SLSQP",
        constraints=[LinearConstraint(model.A * model.length, ub=model.b - model.A @ model.start)]
        if len(model.b)
        else [],
        options={"maxiter": 200},
    )
    moved = replace(point, s=model.start + model.length * solution.x)
    return moved, control_margin(task, moved, spins)
