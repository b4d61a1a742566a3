"""The three subproblems of Alg. 1: convex in thrusts, convex in shape, a sphere product in d."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import minimize

from diffsim.copter.codesign.hover import LEVEL
from diffsim.copter.codesign.metrics import require_cvxpy
from diffsim.copter.codesign.options import AlternatingOptions
from diffsim.copter.codesign.result import CoDesignError
from diffsim.copter.codesign.task import Point, Task
from diffsim.copter.codesign.wrench import skew
from diffsim.copter.vehicle.multicopter import GRAVITY
from diffsim.core.arrays import Array

_HALVINGS = 8  # of a shape step that the linearized positions overrate


def weight_of(task: Task, mass: float) -> float:
    """Weight that hover balances [N]: fixed unless mass is a metric (thesis below eq. 3.19)."""
    return GRAVITY * (mass if "mass" in task.weights else task.scales.mass)


def effect_matrices(task: Task, point: Point) -> tuple[Array, Array]:
    """M_f and M_t, (3, n_rotors) each, over m g and m g L."""
    shape, rotors = task.model.at(point.s), task.rotors
    reaction = point.spins * task.model.vehicle.torque_ratios.numpy()
    torque = np.cross(shape.positions, point.d) + reaction[:, None] * point.d
    return point.d.T / rotors.weight, torque.T / (rotors.weight * rotors.length)


def metric_of(task: Task, s: Array, u: Array) -> float:
    """E(u, s): the weighted relative metrics."""
    w, scales = task.weights, task.scales
    shape = task.model.at(s)
    value = w.get("payload", 0.0) * float((u / task.model.vehicle.max_thrusts.numpy()).max())
    if task.currents is not None:
        current = task.currents.current(u)
        value += w.get("current", 0.0) * float(current.sum()) / scales.current
        value += w.get("max_current", 0.0) * float(current.max()) / scales.max_current
    size = w.get("size", 0.0) - w.get("flight_time", 0.0)
    value += size * shape.size / scales.size + w.get("cost", 0.0) * shape.cost / scales.cost
    return value + w.get("mass", 0.0) * shape.mass / scales.mass


def soft_energy(task: Task, point: Point, u: Array, options: AlternatingOptions) -> float:
    """Eq. 3.9 in relative units."""
    force, torque = effect_matrices(task, point)
    weight = weight_of(task, task.model.at(point.s).mass) / task.rotors.weight
    off_force, off_torque = force @ u + weight * LEVEL, torque @ u
    soft = options.eta * float(off_force @ off_force) + options.mu * float(off_torque @ off_torque)
    return metric_of(task, point.s, u) + soft


def thrust_step(task: Task, point: Point, options: AlternatingOptions) -> Array:
    """The best thrusts (n_rotors,) [N] for a shape and directions: a convex program."""
    cp = require_cvxpy()
    force, torque = effect_matrices(task, point)
    weight = weight_of(task, task.model.at(point.s).mass) / task.rotors.weight
    top = task.model.vehicle.max_thrusts.numpy()
    v = cp.Variable(len(top))
    terms = [
        options.eta * cp.sum_squares(force * top @ v + weight * LEVEL),
        options.mu * cp.sum_squares(torque * top @ v),
    ]
    if "payload" in task.weights:
        terms.append(task.weights["payload"] * cp.max(v))
    if task.currents is not None:
        scale = task.currents.scale * top**task.currents.exponent
        powers = [
            scale[i] * cp.power(v[i], task.currents.exponent[i], approx=False)
            for i in range(len(top))
        ]
        terms.append(task.weights.get("current", 0.0) / task.scales.current * sum(powers))
        most = cp.maximum(*powers) if len(powers) > 1 else powers[0]
        terms.append(task.weights.get("max_current", 0.0) / task.scales.max_current * most)
    _solve(cp, cp.Problem(cp.Minimize(sum(terms)), [v >= 0.0, v <= 1.0]), "thrusts")
    return np.clip(v.value, 0.0, 1.0) * top


def shape_step(task: Task, point: Point, u: Array, options: AlternatingOptions) -> Point:
    """The best shape for thrusts and directions: convex once positions are linear in s.

    They are not quite (rods have mass, which moves the center of mass), so they are linearized and
    the step is halved until the energy does not rise.
    """
    cp = require_cvxpy()
    model, rotors, w, scales = task.model, task.rotors, task.weights, task.scales
    shape = model.at(point.s)
    step = cp.Variable(model.num_params)  # relative to L
    moved = np.cross(shape.d_positions, point.d[..., None], axisa=1, axisb=1, axisc=1)
    slope = np.einsum("i,iap->ap", u, moved) / rotors.weight
    torque = effect_matrices(task, point)[1] @ u
    terms = [options.mu * cp.sum_squares(torque + slope @ step)]
    size = w.get("size", 0.0) - w.get("flight_time", 0.0)
    by_step = size / scales.size * shape.d_size + w.get("cost", 0.0) / scales.cost * shape.d_cost
    by_step = (by_step + w.get("mass", 0.0) / scales.mass * shape.d_mass) * rotors.length
    terms.append(by_step @ step)
    if "mass" in w:
        force = effect_matrices(task, point)[0] @ u
        heavier = shape.d_mass * rotors.length * GRAVITY / rotors.weight
        level = np.outer(LEVEL, heavier)
        residual = force + shape.mass * GRAVITY / rotors.weight * LEVEL
        terms.append(options.eta * cp.sum_squares(residual + level @ step))
    reach = task.limits.extent - (point.s - model.start) / rotors.length
    back = task.limits.extent + (point.s - model.start) / rotors.length
    limits = [step <= reach, step >= -back]
    if len(model.b):
        limits.append(model.A @ step * rotors.length <= model.b - model.A @ point.s)
    # where the energy does not depend on a parameter, it stays
    terms.append(1e-9 * cp.sum_squares(step))
    _solve(cp, cp.Problem(cp.Minimize(sum(terms)), limits), "shape")
    before = soft_energy(task, point, u, options)
    for halving in range(_HALVINGS):
        trial = replace(point, s=point.s + 0.5**halving * rotors.length * step.value)
        if soft_energy(task, trial, u, options) <= before:
            return trial
    return point


def direction_step(task: Task, point: Point, u: Array, options: AlternatingOptions) -> Point:
    """The best directions for thrusts and shape: a QCQP with |d_i| <= 1, then SQP with = 1."""
    cp = require_cvxpy()
    rotors, n = task.rotors, len(u)
    shape = task.model.at(point.s)
    reaction = point.spins * task.model.vehicle.torque_ratios.numpy()
    levers = reaction[:, None, None] * np.eye(3) + skew(shape.positions)
    by_force = np.hstack([u[i] * np.eye(3) for i in range(n)]) / rotors.weight
    by_torque = np.hstack([u[i] * levers[i] for i in range(n)]) / (rotors.weight * rotors.length)
    rows = np.vstack([np.sqrt(options.eta) * by_force, np.sqrt(options.mu) * by_torque])
    weight = weight_of(task, shape.mass) / rotors.weight
    offset = np.concatenate([np.sqrt(options.eta) * weight * LEVEL, np.zeros(3)])
    d = cp.Variable((n, 3))
    upright = -np.cos(task.limits.max_tilt)
    flat = cp.reshape(d, (3 * n,), order="C")
    relaxed = cp.Problem(
        cp.Minimize(cp.sum_squares(rows @ flat + offset)),
        [cp.norm(d, axis=1) <= 1.0, d[:, 2] <= upright],
    )
    _solve(cp, relaxed, "directions")
    guess = d.value / np.linalg.norm(d.value, axis=1, keepdims=True)

    def energy(x: Array) -> tuple[float, Array]:
        off = rows @ x + offset
        return float(off @ off), 2.0 * rows.T @ off

    def unit(x: Array) -> Array:
        return (x.reshape(n, 3) ** 2).sum(1) - 1.0

    def unit_slope(x: Array) -> Array:
        slope = np.zeros((n, n, 3))
        slope[np.arange(n), np.arange(n)] = 2.0 * x.reshape(n, 3)
        return slope.reshape(n, 3 * n)

    bounds = [(-1.0, 1.0), (-1.0, 1.0), (-1.0, upright)] * n
    best = point
    for first in (guess, point.d):
        solution = minimize(
            energy,
            first.ravel(),
            jac=True,
            method="SLSQP",
            bounds=bounds,
            constraints={"type": "eq", "fun": unit, "jac": unit_slope},
            options={"ftol": 1e-14, "maxiter": 200},
        )
        d_new = solution.x.reshape(n, 3)
        d_new = d_new / np.linalg.norm(d_new, axis=1, keepdims=True)
        trial = replace(point, d=d_new)
        if soft_energy(task, trial, u, options) < soft_energy(task, best, u, options):
            best = trial
    return best


def _solve(cp: Any, problem: Any, what: str) -> None:
    problem.solve(solver=cp.CLARABEL)
    if problem.status not in ("optimal", "optimal_inaccurate"):
        raise CoDesignError(
            f"the convex subproblem for {what} ended {problem.status!r}; check the feasible set "
            f"and the thrust limits of the design",
            residual=float("nan"),
        )
