"""A lower bound of the objective over all designs: what no tilt, shape or spin can beat.

Balance of force says |sum u_i d_i| = m(s) g with unit d_i, so sum u_i >= m(s) g. Keeping that
alone (no torque, no directions) leaves a convex program; its dual value is a certificate. For the
payload metric of a fixed mass it is m g / sum u_max: no design lifts more than all thrust limits.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from diffsim.copter.codesign.limits import Scales
from diffsim.copter.codesign.metrics import ALTERNATING, require_cvxpy
from diffsim.copter.codesign.space import Shape
from diffsim.copter.codesign.task import Task
from diffsim.copter.vehicle.multicopter import GRAVITY


def lower_bound(task: Task) -> float:
    """Lower bound of the weighted objective; -inf where the relaxation says nothing.

    Metrics of control (authority, one_rotor_out, response) are bounded by what they cannot pass:
    one_rotor_out by the thrusts that are left without the strongest rotor, response by 0;
    authority has no bound. Mass, size and cost must be linear in s.
    """
    model, w, scales = task.model, task.weights, task.scales
    if "authority" in w:
        return -np.inf
    shape = model.at(model.start)
    nothing = np.zeros((model.num_rotors, 3))
    bends, bends_size = np.zeros((1, 1)), np.zeros((1, 1))
    if any(name in w for name in ALTERNATING if name != "payload"):
        bends = model.hessian(model.start, 1.0 / scales.mass, 1.0 / scales.cost, 0.0, nothing)
        bends_size = model.hessian(model.start, 0.0, 0.0, 1.0 / scales.size, nothing)
    curved = max(np.abs(bends).max(initial=0.0), np.abs(bends_size).max(initial=0.0))
    if curved * model.length**2 > 1e-8:
        return -np.inf
    return _dual_bound(task, shape, w, scales)


def _dual_bound(task: Task, shape: Shape, w: Mapping[str, float], scales: Scales) -> float:
    """max over y >= 0 of min over u, s of objective + y (m(s) g - sum u)."""
    cp = require_cvxpy()
    model = task.model
    fixed = "shape" not in task.limits.free
    top = model.vehicle.max_thrusts.numpy()
    u, step = cp.Variable(len(top)), cp.Variable(model.num_params)
    mass = shape.mass + shape.d_mass @ step
    constraints = [u >= 0.0, u <= top]
    if any(name in w for name in ("current", "max_current", "mass", "size", "flight_time", "cost")):
        constraints.append(cp.sum(u) >= mass * GRAVITY)
    if fixed:
        constraints.append(step == 0.0)
    elif len(model.b):
        constraints.append(model.A @ step <= model.b - model.A @ model.start)
    reach = task.limits.extent * model.length
    if np.isfinite(reach):
        constraints.append(cp.abs(step) <= reach)
    terms = []
    if "payload" in w:
        loaded = cp.Variable(len(top))
        constraints += [loaded >= 0.0, cp.sum(loaded) >= shape.mass * GRAVITY]
        terms.append(w["payload"] * cp.max(loaded / top))
    if "one_rotor_out" in w:  # after losing the weakest rotor the rest carries the weight
        terms.append(w["one_rotor_out"] * shape.mass * GRAVITY / (top.sum() - top.max()))
    if task.currents is not None:
        powers = [
            scale * cp.power(u[i], exponent, approx=False)
            for i, (scale, exponent) in enumerate(
                zip(task.currents.scale, task.currents.exponent, strict=True)
            )
        ]
        if "current" in w:
            terms.append(w["current"] / scales.current * sum(powers))
        if "max_current" in w:
            terms.append(w["max_current"] / scales.max_current * cp.maximum(*powers))
    size = w.get("size", 0.0) - w.get("flight_time", 0.0)
    terms.append(size / scales.size * (shape.size + shape.d_size @ step))
    terms.append(w.get("cost", 0.0) / scales.cost * (shape.cost + shape.d_cost @ step))
    terms.append(w.get("mass", 0.0) / scales.mass * mass)
    problem = cp.Problem(cp.Minimize(sum(terms)), constraints)
    problem.solve(solver=cp.CLARABEL)
    if problem.status == "unbounded":
        return -np.inf
    if problem.status != "optimal":
        raise RuntimeError(f"the relaxation of the co-design problem ended {problem.status}")
    return float(problem.value) - 1e-7 * abs(float(problem.value))  # of the solver's gap
