"""Spins by the condition of the controllability matrix, as the thesis chooses them (eq. 3.8)."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import torch

from diffsim.copter.codesign.errors import CoDesignError
from diffsim.copter.codesign.task import Point, Task
from diffsim.copter.dynamics.control_metrics import controllability
from diffsim.copter.dynamics.linearize import linearize
from diffsim.core.arrays import Array


def condition_number(task: Task, point: Point, u: Array) -> float:
    """Condition number of [B, A B, ..., A^11 B] in level hover with u; inf: uncontrollable."""
    attitude = torch.zeros(2, dtype=torch.float64)
    A, B = linearize(task.vehicle(point), torch.tensor(u), attitude)
    return float(controllability(A, B).condition)


def least_norm_thrusts(task: Task, point: Point) -> Array:
    """Level hover of least norm, no bounds, (n_rotors,) [N]: the thesis's fixed point."""
    vehicle = task.vehicle(point)
    rows = torch.cat([vehicle.force_matrix, vehicle.torque_matrix]).numpy()
    weight = float(vehicle.weight)
    return np.linalg.lstsq(rows, np.array([0.0, 0.0, -weight, 0.0, 0.0, 0.0]), rcond=None)[0]


def spin_conditions(task: Task, point: Point) -> list[tuple[Array, float]]:
    """Condition number of all 2^n assignments, best first (ties: in binary order)."""
    conditions = []
    for signs in itertools.product((1.0, -1.0), repeat=task.model.num_rotors):
        trial = replace(point, spins=np.array(signs))
        u = least_norm_thrusts(task, trial)
        conditions.append((trial.spins, condition_number(task, trial, u)))
    return sorted(conditions, key=lambda pair: pair[1])


def most_controllable(task: Task, point: Point) -> Array:
    """The assignment of the smallest condition number.

    Raises:
        CoDesignError: none is controllable.
    """
    spins, condition = spin_conditions(task, point)[0]
    if not np.isfinite(condition):
        raise CoDesignError(
            f"none of {2 ** len(spins)} spin assignments makes the start controllable, and the "
            "alternation has no way on from there; use method 'joint', which moves the start",
            residual=float("inf"),
        )
    return spins
