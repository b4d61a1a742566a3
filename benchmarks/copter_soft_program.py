"""The thesis's co-design problem as published (eq. 3.9), for general solvers.

Unknowns y = [v, z, d] or [v, z, d, t]: relative thrusts, relative shape steps, directions, and in
the epigraph form a bound t of each largest-of metric. Hover is a penalty; the body is level.
"""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, LinearConstraint, NonlinearConstraint, minimize

from diffsim.copter.codesign import AlternatingOptions, wrench
from diffsim.copter.codesign.hover import LEVEL
from diffsim.copter.codesign.steps import soft_energy
from diffsim.copter.codesign.task import Point, Task
from diffsim.copter.codesign.wrench import Case, Rotors

Array = NDArray[np.float64]

LARGEST = ("payload", "max_current")


class SoftProgram:
    """Eq. 3.9 with its bounds, smooth (``epigraph``) or with the maximum in the objective."""

    def __init__(self, task: Task, spins: Array, options: AlternatingOptions, *, epigraph: bool):
        self.task, self.epigraph = task, epigraph
        bare = task.program(spins)
        self.rotors: Rotors = bare.rotors
        self.options = options.relative(self.rotors)
        self.n, self.p = task.model.num_rotors, task.model.num_params
        self.case = Case("hover", fixed_weight="mass" not in task.weights)
        self.spins = spins
        self.bounded = [m for m in LARGEST if m in task.weights] if epigraph else []
        self.size = 4 * self.n + self.p + len(self.bounded)
        self.v, self.z = slice(0, self.n), slice(self.n, self.n + self.p)
        self.d = slice(self.n + self.p, 4 * self.n + self.p)

    def pack(self, point: Point, u: Array) -> Array:
        z = (point.s - self.task.model.start) / self.rotors.length
        v = u / self.rotors.max_thrusts
        largest = [float(self._largest(name, v)[0].max()) for name in self.bounded]
        return np.concatenate([v, z, point.d.ravel(), largest])

    def unpack(self, y: Array) -> tuple[Point, Array]:
        s = self.task.model.start + self.rotors.length * y[self.z]
        d = y[self.d].reshape(-1, 3)
        d = d / np.linalg.norm(d, axis=1, keepdims=True)
        return Point(s, d, self.spins, LEVEL), np.clip(
            y[self.v], 0.0, 1.0
        ) * self.rotors.max_thrusts

    def energy(self, y: Array) -> float:
        """Eq. 3.9 at unit directions, whatever the form."""
        point, u = self.unpack(y)
        return soft_energy(self.task, point, u, self.options)

    def _largest(self, name: str, v: Array) -> tuple[Array, Array]:
        """What the metric is the largest of, and the slope by each v."""
        if name == "payload":
            return v, np.ones(self.n)
        model, scale = self.task.currents, self.task.scales.max_current
        assert model is not None
        top = self.rotors.max_thrusts
        u = np.maximum(v, 0.0) * top
        current = model.current(u) / scale
        return current, model.exponent * model.scale * u ** (model.exponent - 1.0) * top / scale

    def objective(self, y: Array) -> tuple[float, Array]:
        """Value and gradient (one of the maximum's subgradients where it is not smooth)."""
        task, w, scales = self.task, self.task.weights, self.task.scales
        v, d = y[self.v], y[self.d].reshape(-1, 3)
        shape = task.model.at(task.model.start + self.rotors.length * y[self.z])
        force, by_force = wrench.forces(v, d, LEVEL, shape, self.rotors, self.case)
        torque, by_torque = wrench.torques(v, d, shape, self.rotors)
        value, grad = 0.0, np.zeros(self.size)
        parts = ((self.options.eta, force, by_force), (self.options.mu, torque, by_torque))
        for weight, off, by in parts:
            value += weight * float(off @ off)
            grad[self.v] += 2.0 * weight * off @ by.v
            grad[self.d] += 2.0 * weight * off @ by.d
            grad[self.z] += 2.0 * weight * off @ by.z
        for name in LARGEST:
            if name not in w:
                continue
            if self.epigraph:
                at = 4 * self.n + self.p + self.bounded.index(name)
                value += w[name] * y[at]
                grad[at] += w[name]
            else:
                values, slope = self._largest(name, v)
                i = int(values.argmax())
                value += w[name] * values[i]
                grad[i] += w[name] * slope[i]
        if "current" in w:
            assert task.currents is not None
            u, e = np.maximum(v, 0.0) * self.rotors.max_thrusts, task.currents.exponent
            value += w["current"] * float(task.currents.current(u).sum()) / scales.current
            slope = e * task.currents.scale * u ** (e - 1.0) * self.rotors.max_thrusts
            grad[self.v] += w["current"] * slope / scales.current
        size = (w.get("size", 0.0) - w.get("flight_time", 0.0)) / scales.size
        cost, mass = w.get("cost", 0.0) / scales.cost, w.get("mass", 0.0) / scales.mass
        value += size * shape.size + cost * shape.cost + mass * shape.mass
        by_shape = size * shape.d_size + cost * shape.d_cost + mass * shape.d_mass
        grad[self.z] += self.rotors.length * by_shape
        return value, grad

    def unit(self, y: Array) -> Array:
        return (y[self.d].reshape(-1, 3) ** 2).sum(1) - 1.0

    def unit_slope(self, y: Array) -> Array:
        slope = np.zeros((self.n, self.size))
        for i in range(self.n):
            at = self.d.start + 3 * i
            slope[i, at : at + 3] = 2.0 * y[at : at + 3]
        return slope

    def above(self, y: Array) -> Array:
        """t - values of the largest-of metrics, not negative."""
        if not self.bounded:
            return np.zeros(0)
        tops = y[4 * self.n + self.p :]
        pairs = zip(self.bounded, tops, strict=True)
        return np.concatenate([t - self._largest(name, y[self.v])[0] for name, t in pairs])

    def above_slope(self, y: Array) -> Array:
        slope = np.zeros((self.n * len(self.bounded), self.size))
        for k, name in enumerate(self.bounded):
            rows = slice(k * self.n, (k + 1) * self.n)
            slope[rows, self.v] = -np.diag(self._largest(name, y[self.v])[1])
            slope[rows, 4 * self.n + self.p + k] = 1.0
        return slope

    def bounds(self) -> tuple[Array, Array]:
        low, high = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        low[self.v], high[self.v] = 0.0, 1.0
        low[self.z], high[self.z] = -self.task.limits.extent, self.task.limits.extent
        low[self.d], high[self.d] = -1.0, 1.0
        high[self.d.start + 2 : self.d.stop : 3] = -np.cos(self.task.limits.max_tilt)
        return low, high

    def shape_rows(self) -> tuple[Array, Array]:
        """Rows and limits of A s <= b in y."""
        model = self.task.model
        rows = np.zeros((len(model.b), self.size))
        rows[:, self.z] = model.A * self.rotors.length
        return rows, model.b - model.A @ model.start


def solve_scipy(program: SoftProgram, start: Array, method: str, max_iters: int) -> dict:
    """Energies after each iteration, times, and the end, by SLSQP or trust-constr."""
    low, high = program.bounds()
    start = np.clip(start, low, high)
    rows, limit = program.shape_rows()
    energies, seconds, began = [program.energy(start)], [0.0], time.perf_counter()
    cpu = time.process_time()

    def note(y: Array, *_: object) -> None:
        energies.append(program.energy(y))
        seconds.append(time.perf_counter() - began)

    constraints = [NonlinearConstraint(program.unit, 0.0, 0.0, jac=program.unit_slope)]
    if len(limit):
        constraints.append(LinearConstraint(rows, ub=limit))
    if program.bounded:
        constraints.append(NonlinearConstraint(program.above, 0.0, np.inf, jac=program.above_slope))
    options: dict[str, float] = {"maxiter": max_iters}
    options |= {"ftol": 1e-6} if method == "SLSQP" else {"xtol": 1e-8, "gtol": 1e-6}
    found = minimize(
        program.objective,
        start,
        jac=True,
        method=method,
        bounds=Bounds(low, high),
        constraints=constraints,
        callback=note,
        options=options,
    )
    return {
        "energies": energies,
        "seconds": seconds,
        "cpu": time.process_time() - cpu,
        "y": found.x,
        "message": str(found.message),
    }


def solve_active_set(program: SoftProgram, start: Array, max_iters: int) -> dict:
    """The same by filterSQP: trust-region SQP whose quadratic programs an active-set method solves.

    Second derivatives are central differences of the Lagrangian's gradient.
    """
    import unopy

    low, high = program.bounds()
    start = np.clip(start, low, high)
    rows, limit = program.shape_rows()
    n, num_above = program.size, len(program.above(start))
    m = program.n + len(limit) + num_above
    energies, seconds, began = [program.energy(start)], [0.0], time.perf_counter()
    cpu = time.process_time()

    def constraints(y: Array, out: Array) -> None:
        y = np.array(y)
        out[:] = np.concatenate([program.unit(y), rows @ y, program.above(y)])

    def slopes(y: Array) -> Array:
        return np.vstack([program.unit_slope(y), rows, program.above_slope(y)])

    def jacobian(y: Array, out: Array) -> None:
        out[:] = slopes(np.array(y)).ravel()

    def gradient(y: Array, out: Array) -> None:
        out[:] = program.objective(np.array(y))[1]

    lower = np.tril_indices(n)

    def hessian(y: Array, factor: float, w: Array, out: Array) -> None:
        y, w, h = np.array(y), np.array(w), 1e-5

        def lagrangian(x: Array) -> Array:
            return factor * program.objective(x)[1] + w @ slopes(x)

        columns = [(lagrangian(y + h * e) - lagrangian(y - h * e)) / (2.0 * h) for e in np.eye(n)]
        full = np.array(columns)
        out[:] = (0.5 * (full + full.T))[lower]

    def note(y: Array, *_: object) -> None:
        energies.append(program.energy(np.array(y)[:n]))
        seconds.append(time.perf_counter() - began)

    row, column = np.divmod(np.arange(m * n), n)
    model = unopy.Model(
        unopy.PROBLEM_NONLINEAR, n, low.tolist(), high.tolist(), unopy.ZERO_BASED_INDEXING
    )
    model.set_objective(unopy.MINIMIZE, lambda y: program.objective(np.array(y))[0], gradient)
    least = [0.0] * program.n + [-np.inf] * len(limit) + [0.0] * num_above
    most = [0.0] * program.n + limit.tolist() + [np.inf] * num_above
    model.set_constraints(
        m, constraints, least, most, m * n, row.tolist(), column.tolist(), jacobian
    )
    model.set_lagrangian_hessian(
        len(lower[0]), unopy.LOWER_TRIANGLE, lower[0].tolist(), lower[1].tolist(), hessian
    )
    model.set_lagrangian_sign_convention(unopy.MULTIPLIER_POSITIVE)
    model.set_initial_primal_iterate(start.tolist())
    uno = unopy.UnoSolver()
    uno.set_preset("filtersqp")
    settings = {"logger": "SILENT", "max_iterations": max_iters, "dual_tolerance": 1e-6}
    for name, value in settings.items():
        uno.set_option(name, value)
    uno.set_notify_acceptable_iterate_callback(note)
    found = uno.optimize(model)
    return {
        "energies": energies,
        "seconds": seconds,
        "cpu": time.process_time() - cpu,
        "y": np.array(found.primal_solution),
        "message": found.solution_status.name,
    }
