"""Exact Hessian of a co-design program's Lagrangian."""

from __future__ import annotations

import numpy as np

from diffsim.copter.codesign import wrench
from diffsim.copter.codesign.program import Program
from diffsim.copter.codesign.space import Shape
from diffsim.core.arrays import Array


def lagrangian_hessian(
    program: Program, x: Array, equal: Array, unequal: Array, of_objective: float = 1.0
) -> Array:
    """Second derivative of of_objective * objective + equal . equalities + unequal . inequalities.

    Args:
        x: All unknowns, (num_all,).
        equal: Multipliers of ``program.equalities``.
        unequal: Multipliers of ``program.inequalities``.

    Returns:
        (num_all, num_all), symmetric.

    Raises:
        NotImplementedError: the response metric, whose inertia has first derivatives only.
    """
    if "response" in program.aux:
        raise NotImplementedError("the response metric has no second derivatives; use SLSQP")
    s, d, gamma, _, v = program.split(x)
    shape, rotors, n = program.shape(s), program.rotors, program.n
    half = np.zeros((program.num_all, program.num_all))
    z, g, directions = program.at["z"], program.at["gamma"], program.at["d"]
    of_mass, of_positions = 0.0, np.zeros((n, 3))
    row = 0
    for c, case in enumerate(program.cases):
        y_force = equal[row : row + case.num_force]
        y_torque = np.zeros(3)
        y_torque[list(case.axes)] = equal[row + case.num_force :][: len(case.axes)]
        row += case.num_force + len(case.axes)
        part = wrench.curvature(y_force, y_torque, v[c], d, gamma, shape, rotors, case)
        of_mass += part.of_mass
        of_positions += part.of_positions
        thrusts = program.thrusts_at(c)
        for i in range(n):
            own = slice(directions.start + 3 * i, directions.start + 3 * i + 3)
            half[thrusts.start + i, own] += part.v_d[i]
            half[own, g] += part.d_gamma[i] * np.eye(3)
            half[own, z] += part.d_z[i]
        half[thrusts, g] += part.v_gamma
        half[thrusts, z] += part.v_z
        half[g, z] += part.gamma_z
    full = half + half.T
    for block, name in (("d", "directions"), ("gamma", "attitude")):
        if name in program.limits.free:
            count = (program.at[block].stop - program.at[block].start) // 3
            twice = 2.0 * np.repeat(equal[row : row + count], 3)
            index = np.arange(program.at[block].start, program.at[block].stop)
            full[index, index] += twice
            row += count
    of_currents = _inequality_part(program, unequal, shape, full, of_positions)
    if "current" in program.weights:
        of_currents = (
            of_currents + of_objective * program.weights["current"] / program.scales.current
        )
    if program.currents is not None and of_currents.any():
        now, thrusts = program.hover_currents(s, v[0]), program.thrusts_at(0)
        index = np.arange(thrusts.start, thrusts.stop)
        full[index, index] += of_currents * now.by_v_v
        cross = of_currents[:, None] * now.by_v_z
        full[thrusts, z] += cross
        full[z, thrusts] += cross.T
        full[z, z] += float(of_currents @ now.by_z_z) * np.outer(now.d_share, now.d_share)
        of_mass += float(of_currents @ now.by_mass)
    of_size, of_cost, of_own_mass = (of_objective * term[0] for term in program.shape_terms(shape))
    curved = program.model.hessian(s, of_mass + of_own_mass, of_cost, of_size, of_positions)
    placed = np.arange(program.at["aux"].start)
    full[placed, placed] += of_objective * program.limits.nearness
    full[z, z] += rotors.length**2 * curved
    return full


def _inequality_part(
    program: Program, y: Array, shape: Shape, full: Array, of_positions: Array
) -> Array:
    """Adds clearance to the Hessian; returns the weights of the currents' second derivatives."""
    row = len(program.model.b) if "shape" in program.limits.free else 0
    row += program.n * sum(case.cap is not None for case in program.cases)
    of_currents = np.zeros(program.n)
    if "max_current" in program.weights:
        of_currents = -y[row : row + program.n] / program.scales.max_current
        row += program.n
    z = program.at["z"]
    for k, (i, j) in enumerate(program.pairs):
        moved = (shape.d_positions[i] - shape.d_positions[j])[:2]
        full[z, z] += 2.0 * y[row + k] * moved.T @ moved
        across = 2.0 * y[row + k] * (shape.positions[i] - shape.positions[j])
        across[2] = 0.0
        of_positions[i] += across / program.rotors.length**2
        of_positions[j] -= across / program.rotors.length**2
    return of_currents
