"""Balance of force and torque in one flight case, with first and second derivatives.

With u thrusts, d unit directions, r positions relative to the center of mass, gamma the direction
of gravity in the body frame, W = m(s) g + load:

    force   sum_i u_i d_i + W gamma                      = 0   (thesis eq. 3.2 at rest)
    lift    -gamma . sum_i u_i d_i - W                   = 0   (its part along gravity only)
    torque  sum_i u_i (b_i lambda_i d_i + r_i x d_i)     = q tau   (eq. 3.3; q may be unknown)

Everything is relative: force to m0 g, torque to m0 g L, shape steps z = (s - s0) / L,
thrusts v = u / u_max.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffsim.copter.codesign.space import Shape
from diffsim.core.arrays import Array


@dataclass(frozen=True)
class Rotors:
    """Constants of the rotors and units."""

    max_thrusts: Array  # largest thrust of each rotor, (n_rotors,) [N]
    reaction: Array  # b_i lambda_i, (n_rotors,) [m]
    mass: float  # m0 [kg]
    weight: float  # m0 g [N]
    length: float  # L [m]


@dataclass(frozen=True)
class Case:
    """One thing that the rotors have to be able to do at the same time as all other cases."""

    name: str  # name of the case in messages
    lift_only: bool = False  # balance force along gravity only
    axes: tuple[int, ...] = (0, 1, 2)  # body axes whose torque is prescribed
    # tau, (3,), relative; with ``inertia_axis`` it is J(s) e instead
    torque: tuple[float, ...] = (0.0, 0.0, 0.0)
    aux: str | None = None  # name of the unknown q that tau is multiplied with; None: 1
    cap: str | None = None  # name of the unknown that bounds v; None: 1
    load: float = 0.0  # extra weight over m0 g
    # W is m0 g whatever the shape: the flight case of thrusts that are scaled by m0 g over the
    # overall weight lifted
    fixed_weight: bool = False
    dead_rotor: int | None = None  # one that gives no thrust
    inertia_axis: tuple[float, float, float] | None = None  # (3,) e of the response metric

    def weight(self, shape: Shape, rotors: Rotors) -> tuple[float, float]:
        """W over m0 g, and its derivative by m(s) [1/kg]."""
        if self.fixed_weight:
            return 1.0, 0.0
        return shape.mass / rotors.mass + self.load, 1.0 / rotors.mass

    @property
    def num_force(self) -> int:
        """Rows of the force balance."""
        return 1 if self.lift_only else 3


@dataclass(frozen=True)
class Blocks:
    """Derivative blocks of m rows by v (m, n), d (m, 3 n), gamma (m, 3) and z (m, p)."""

    v: Array
    d: Array
    gamma: Array
    z: Array


def skew(r: Array) -> Array:
    """[r]x of (..., 3), so that [r]x d = r x d."""
    zero = np.zeros(r.shape[:-1])
    x, y, z = np.moveaxis(r, -1, 0)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def forces(
    v: Array, d: Array, gamma: Array, shape: Shape, rotors: Rotors, case: Case
) -> tuple[Array, Blocks]:
    """Residual of the force balance, (3,) or (1,), and its derivatives."""
    n, p = len(v), len(shape.d_mass)
    pull = v * rotors.max_thrusts / rotors.weight
    weight, by_mass = case.weight(shape, rotors)
    d_weight = shape.d_mass * rotors.length * by_mass
    by_v = d.T * (rotors.max_thrusts / rotors.weight)
    by_d = np.einsum("i,ab->aib", pull, np.eye(3)).reshape(3, 3 * n)
    net = d.T @ pull
    if case.lift_only:
        residual = np.array([-gamma @ net - weight])
        blocks = Blocks(-(gamma @ by_v)[None], -(gamma @ by_d)[None], -net[None], -d_weight[None])
        return residual, blocks
    by_z = np.outer(gamma, d_weight) if p else np.zeros((3, 0))
    return net + weight * gamma, Blocks(by_v, by_d, weight * np.eye(3), by_z)


def torques(v: Array, d: Array, shape: Shape, rotors: Rotors) -> tuple[Array, Blocks]:
    """Torque of the rotors, (3,), and its derivatives."""
    unit = rotors.weight * rotors.length
    u = v * rotors.max_thrusts
    levers = rotors.reaction[:, None, None] * np.eye(3) + skew(shape.positions)  # (n, 3, 3)
    arms = np.einsum("iab,ib->ai", levers, d)
    by_d = np.einsum("i,iab->aib", u, levers).reshape(3, -1) / unit
    moved = np.cross(shape.d_positions, d[..., None], axisa=1, axisb=1, axisc=1)
    by_z = np.einsum("i,iap->ap", u, moved) * (rotors.length / unit)
    blocks = Blocks(arms * rotors.max_thrusts / unit, by_d, np.zeros((3, 3)), by_z)
    return arms @ u / unit, blocks


@dataclass
class Curvature:
    """Second derivatives of a weighted sum of residuals; blocks that do not vanish.

    of_mass and of_positions are what the Hessian of the shape is to be weighted with.
    """

    v_d: Array  # (n, 3): v_i with d_i
    v_gamma: Array  # (n, 3)
    v_z: Array  # (n, p)
    d_gamma: Array  # (n,): times the identity, d_i with gamma
    d_z: Array  # (n, 3, p)
    gamma_z: Array  # (3, p)
    of_mass: float
    of_positions: Array  # (n, 3)


def curvature(
    y_force: Array,
    y_torque: Array,
    v: Array,
    d: Array,
    gamma: Array,
    shape: Shape,
    rotors: Rotors,
    case: Case,
) -> Curvature:
    """Second derivatives of y_force . force + y_torque . torque; y_torque has all 3 axes.

    y . (r x d) = r . (d x y) = d . (y x r).
    """
    unit, length = rotors.weight * rotors.length, rotors.length
    by_mass = case.weight(shape, rotors)[1]
    pull = rotors.max_thrusts / rotors.weight
    u = v * rotors.max_thrusts
    n, p = len(v), len(shape.d_mass)
    aside = np.cross(d, y_torque)  # (n, 3)
    v_d = (rotors.reaction[:, None] * y_torque + np.cross(y_torque, shape.positions)) / unit
    v_d = v_d * rotors.max_thrusts[:, None]
    v_z = np.einsum("ia,iap->ip", aside, shape.d_positions) * (length / unit)
    turned = np.cross(y_torque[None, :, None], shape.d_positions, axisa=1, axisb=1, axisc=1)
    out = Curvature(
        v_d=v_d,
        v_gamma=np.zeros((n, 3)),
        v_z=v_z * rotors.max_thrusts[:, None],
        d_gamma=np.zeros(n),
        d_z=turned * u[:, None, None] * (length / unit),
        gamma_z=np.zeros((3, p)),
        of_mass=0.0,
        of_positions=aside * u[:, None] / unit,
    )
    if case.lift_only:
        y = float(y_force[0])
        out.v_d -= y * pull[:, None] * gamma
        out.v_gamma -= y * pull[:, None] * d
        out.d_gamma -= y * pull * v
        out.of_mass -= y * by_mass
    else:
        out.v_d += pull[:, None] * y_force
        out.gamma_z += np.outer(y_force, shape.d_mass) * (length * by_mass)
        out.of_mass += float(y_force @ gamma) * by_mass
    return out
