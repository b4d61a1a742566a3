"""Co-design as one smooth nonlinear program with hard hover, in epigraph form.

Unknowns x = [z, d, gamma, aux, v]: steps of the shape parameters z = (s - s0) / L, directions of
the rotors, direction of gravity in the body frame (the attitude up to yaw), one bound per
largest-of metric, and relative thrusts v = u / u_max of every flight case. Every constraint is a
polynomial but the currents, and has exact first and second derivatives.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from diffsim.copter.codesign import wrench
from diffsim.copter.codesign.limits import Limits, Scales
from diffsim.copter.codesign.metrics import EPIGRAPH, CurrentModel
from diffsim.copter.codesign.space import Shape, ShapeModel
from diffsim.copter.codesign.wrench import Case, Rotors
from diffsim.copter.vehicle.multicopter import GRAVITY
from diffsim.core.arrays import Array


class Program:
    """Objective, constraints and their derivatives for one spin assignment.

    Attributes:
        lower, upper: Bounds of the free unknowns, (num_unknowns,).
    """

    def __init__(
        self,
        model: ShapeModel,
        spins: Array,
        weights: Mapping[str, float],
        cases: Sequence[Case],
        limits: Limits,
        scales: Scales,
        currents: CurrentModel | None,
    ):
        vehicle = model.vehicle
        self.model, self.weights, self.cases = model, dict(weights), list(cases)
        self.limits, self.scales, self.currents = limits, scales, currents
        mass = float(vehicle.mass)
        self.rotors = Rotors(
            max_thrusts=vehicle.max_thrusts.numpy(),
            reaction=np.asarray(spins, float) * vehicle.torque_ratios.numpy(),
            mass=mass,
            weight=mass * GRAVITY,
            length=model.length,
        )
        self.radii = vehicle.radii.numpy()
        named = {c.cap for c in cases} | {c.aux for c in cases}
        self.aux = [a for a in EPIGRAPH if a in named or a in weights]
        n, p = model.num_rotors, model.num_params
        self.n, self.p = n, p
        sizes = {"z": p, "d": 3 * n, "gamma": 3, "aux": len(self.aux), "v": n * len(cases)}
        ends = np.cumsum(list(sizes.values()))
        self.at = {k: slice(e - c, e) for (k, c), e in zip(sizes.items(), ends, strict=True)}
        self.num_all = int(ends[-1])
        self.home = np.zeros(self.num_all)
        self.home[self.at["d"]] = np.tile([0.0, 0.0, -1.0], n)
        self.home[self.at["gamma"]] = [0.0, 0.0, 1.0]
        self.pairs = self._clearance_pairs()
        self._bound_unknowns()
        self._last: tuple[bytes, Shape] | None = None

    # ---- unknowns

    def _bound_unknowns(self) -> None:
        low, high = np.full(self.num_all, -np.inf), np.full(self.num_all, np.inf)
        low[self.at["z"]], high[self.at["z"]] = -self.limits.extent, self.limits.extent
        d_low, d_high = -np.ones((self.n, 3)), np.ones((self.n, 3))
        d_high[:, 2] = -np.cos(self.limits.max_tilt)
        low[self.at["d"]], high[self.at["d"]] = d_low.ravel(), d_high.ravel()
        sine = np.sin(self.limits.max_attitude)
        low[self.at["gamma"]] = [-sine, -sine, np.cos(self.limits.max_attitude)]
        high[self.at["gamma"]] = [sine, sine, 1.0]
        low[self.at["aux"]] = 0.0
        v_low, v_high = np.zeros((len(self.cases), self.n)), np.ones((len(self.cases), self.n))
        for c, case in enumerate(self.cases):
            if case.cap == "one_rotor_out":
                v_high[c] = np.inf
            if case.dead_rotor is not None:
                v_high[c, case.dead_rotor] = 0.0
        low[self.at["v"]], high[self.at["v"]] = v_low.ravel(), v_high.ravel()
        free = np.ones(self.num_all, bool)
        for name, block in (("shape", "z"), ("directions", "d"), ("attitude", "gamma")):
            free[self.at[block]] = name in self.limits.free
        self.free = free & (low < high)
        self.fixed_value = np.where(np.isfinite(low) & (low == high), low, 0.0)
        self.lower, self.upper = low[self.free], high[self.free]

    def pack(self, s: Array, d: Array, gamma: Array, aux: Mapping[str, float], v: Array) -> Array:
        """All unknowns from their parts; thrusts (num_cases, n_rotors) relative."""
        x = np.empty(self.num_all)
        x[self.at["z"]] = (s - self.model.start) / self.rotors.length
        x[self.at["d"]], x[self.at["gamma"]] = d.ravel(), gamma
        x[self.at["aux"]] = [aux.get(a, 1.0) for a in self.aux]
        x[self.at["v"]] = v.ravel()
        return x

    def split(self, x: Array) -> tuple[Array, Array, Array, dict[str, float], Array]:
        """s (p,), d (n, 3), gamma (3,), aux by name, v (num_cases, n)."""
        s = self.model.start + self.rotors.length * x[self.at["z"]]
        aux = dict(zip(self.aux, x[self.at["aux"]].tolist(), strict=True))
        v = x[self.at["v"]].reshape(-1, self.n)
        return s, x[self.at["d"]].reshape(-1, 3), x[self.at["gamma"]], aux, v

    def shape(self, s: Array) -> Shape:
        """The last shape is kept: objective and constraints ask for the same one."""
        key = s.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = (key, self.model.at(s))
        return self._last[1]

    # ---- objective

    def objective(self, x: Array) -> tuple[float, Array]:
        """Weighted relative metrics plus nearness, and gradient by all unknowns."""
        value, grad = self.metric(x)
        apart = np.where(np.arange(self.num_all) < self.at["aux"].start, x - self.home, 0.0)
        nearness = self.limits.nearness
        return value + 0.5 * nearness * float(apart @ apart), grad + nearness * apart

    def metric(self, x: Array) -> tuple[float, Array]:
        """Weighted relative metrics and gradient by all unknowns."""
        s, _, _, aux, v = self.split(x)
        value, grad = 0.0, np.zeros(self.num_all)
        start = self.at["aux"].start
        for name, weight in self.weights.items():
            if name in self.aux:
                i = start + self.aux.index(name)
                if name == "response":
                    q = max(aux[name], 1e-12)
                    scaled = weight * np.sqrt(self.scales.response)
                    value += scaled / np.sqrt(q)
                    grad[i] -= 0.5 * scaled * q**-1.5
                else:
                    sign = -1.0 if name == "authority" else 1.0
                    value += sign * weight * aux[name]
                    grad[i] += sign * weight
            elif name == "current":
                now = self.hover_currents(s, v[0])
                value += weight * now.value.sum() / self.scales.current
                grad[self.thrusts_at(0)] += weight * now.by_v / self.scales.current
                grad[self.at["z"]] += weight * now.by_z.sum(0) / self.scales.current
        shape = self.shape(s)
        for coefficient, of, d_of in self.shape_terms(shape):
            value += coefficient * of
            grad[self.at["z"]] += coefficient * d_of * self.rotors.length
        return float(value), grad

    def shape_terms(self, shape: Shape) -> list[tuple[float, float, Array]]:
        """Weight, value and gradient by s of size, cost and mass."""
        w, scales = self.weights, self.scales
        size = (w.get("size", 0.0) - w.get("flight_time", 0.0)) / scales.size
        return [
            (size, shape.size, shape.d_size),
            (w.get("cost", 0.0) / scales.cost, shape.cost, shape.d_cost),
            (w.get("mass", 0.0) / scales.mass, shape.mass, shape.d_mass),
        ]

    def hover_currents(self, s: Array, v: Array) -> Currents:
        """Currents of the first case's thrusts v, scaled to the weight without load."""
        assert self.currents is not None
        scaled = self.cases[0].fixed_weight
        return hover_currents(v, self.shape(s), self.rotors, self.currents, scaled=scaled)

    # ---- constraints

    def equalities(self, x: Array) -> tuple[Array, Array]:
        """Balance of every case and unit directions; Jacobian by all unknowns."""
        s, d, gamma, aux, v = self.split(x)
        shape = self.shape(s)
        rows: list[Array] = []
        values: list[Array] = []
        torques = wrench.torques
        for c, case in enumerate(self.cases):
            force, by = wrench.forces(v[c], d, gamma, shape, self.rotors, case)
            values.append(force)
            rows.append(self._row(c, by))
            torque, by = torques(v[c], d, shape, self.rotors)
            row = self._row(c, by)
            target, d_target = self._target(s, case)
            q = aux[case.aux] if case.aux else 1.0
            if case.aux:
                row[:, self.at["aux"].start + self.aux.index(case.aux)] -= target
            row[:, self.at["z"]] -= q * d_target
            axes = list(case.axes)
            values.append((torque - q * target)[axes])
            rows.append(row[axes])
        for block, name in (("d", "directions"), ("gamma", "attitude")):
            if name in self.limits.free:
                vectors = x[self.at[block]].reshape(-1, 3)
                row = np.zeros((len(vectors), self.num_all))
                for i, vector in enumerate(vectors):
                    first = self.at[block].start + 3 * i
                    row[i, first : first + 3] = 2.0 * vector
                values.append((vectors**2).sum(1) - 1.0)
                rows.append(row)
        return np.concatenate(values), np.vstack(rows)

    def inequalities(self, x: Array) -> tuple[Array, Array]:
        """Rows that must not be negative: A s <= b, bounds of largest-of metrics, clearance."""
        s, _, _, aux, v = self.split(x)
        values: list[Array] = []
        rows: list[Array] = []
        if "shape" in self.limits.free and len(self.model.b):
            row = np.zeros((len(self.model.b), self.num_all))
            row[:, self.at["z"]] = -self.model.A
            values.append((self.model.b - self.model.A @ s) / self.rotors.length)
            rows.append(row)
        for c, case in enumerate(self.cases):
            if case.cap is not None:
                row = np.zeros((self.n, self.num_all))
                row[:, self.thrusts_at(c)] = -np.eye(self.n)
                row[:, self.at["aux"].start + self.aux.index(case.cap)] = 1.0
                values.append(aux[case.cap] - v[c])
                rows.append(row)
        if "max_current" in self.weights:
            now = self.hover_currents(s, v[0])
            row = np.zeros((self.n, self.num_all))
            row[:, self.thrusts_at(0)] = -np.diag(now.by_v) / self.scales.max_current
            row[:, self.at["z"]] = -now.by_z / self.scales.max_current
            row[:, self.at["aux"].start + self.aux.index("max_current")] = 1.0
            values.append(aux["max_current"] - now.value / self.scales.max_current)
            rows.append(row)
        if self.pairs:
            shape = self.shape(s)
            i, j = np.array(self.pairs).T
            apart = (shape.positions[i] - shape.positions[j])[:, :2]
            moved = (shape.d_positions[i] - shape.d_positions[j])[:, :2]
            least = self.radii[i] + self.radii[j] + (self.limits.clearance or 0.0)
            row = np.zeros((len(i), self.num_all))
            row[:, self.at["z"]] = 2.0 * np.einsum("ka,kap->kp", apart, moved) / self.rotors.length
            values.append(((apart**2).sum(1) - least**2) / self.rotors.length**2)
            rows.append(row)
        if not values:
            return np.zeros(0), np.zeros((0, self.num_all))
        return np.concatenate(values), np.vstack(rows)

    def hover_thrusts(self, x: Array) -> Array:
        """Thrusts that hover without load, (n_rotors,) [N]."""
        s, _, _, _, v = self.split(x)
        share = self.shape(s).mass / self.rotors.mass if self.cases[0].fixed_weight else 1.0
        return v[0] * self.rotors.max_thrusts * share

    def thrusts_at(self, case: int) -> slice:
        """Where a case's v lie among the unknowns."""
        first = self.at["v"].start + case * self.n
        return slice(first, first + self.n)

    def _row(self, c: int, by: wrench.Blocks) -> Array:
        row = np.zeros((len(by.v), self.num_all))
        row[:, self.thrusts_at(c)], row[:, self.at["d"]] = by.v, by.d
        row[:, self.at["gamma"]], row[:, self.at["z"]] = by.gamma, by.z
        return row

    def _target(self, s: Array, case: Case) -> tuple[Array, Array]:
        """tau and its derivative by z."""
        if case.inertia_axis is None:
            return np.array(case.torque), np.zeros((3, self.p))
        inertia, d_inertia = self.model.inertia(s)
        axis = np.array(case.inertia_axis) / self.scales.inertia
        by_s = np.einsum("abp,b->ap", d_inertia, axis)
        return inertia @ axis, by_s * self.rotors.length

    def _clearance_pairs(self) -> list[tuple[int, int]]:
        """Pairs of rotors that must keep apart: all but those stacked on one axis."""
        if self.limits.clearance is None:
            return []
        r = self.model.vehicle.positions.numpy()
        pairs = []
        for i in range(self.n):
            for j in range(i):
                across = np.linalg.norm((r[i] - r[j])[:2])
                stacked = across < 0.1 * (self.radii[i] + self.radii[j]) and r[i, 2] != r[j, 2]
                if not stacked:
                    pairs.append((i, j))
        return pairs


_LEAST_THRUST = 1e-6  # of the limit; keeps second derivatives of u^alpha, alpha < 2, finite


@dataclass(frozen=True)
class Currents:
    """Currents in hover and what their derivatives are made of."""

    value: Array  # current of each rotor, (n_rotors,) [A]
    # by_v, by_z: first derivatives, (n_rotors,) and (n_rotors, p)
    by_v: Array
    by_z: Array
    # by_v_v, by_v_z: second ones, (n_rotors,) and (n_rotors, p)
    by_v_v: Array
    by_v_z: Array
    by_z_z: Array  # (n_rotors,) times d_share d_share', d_share (p,)
    d_share: Array
    by_mass: Array  # (n_rotors,) times the second derivative of m(s) [A/kg]


def hover_currents(
    v: Array, shape: Shape, rotors: Rotors, model: CurrentModel, *, scaled: bool
) -> Currents:
    """Currents of the rotors in hover without load.

    I = a (u_max v share)^e; share = m / m0 where v carries m0 g (``scaled``), else 1.
    """
    share = shape.mass / rotors.mass if scaled else 1.0
    d_share = shape.d_mass * (rotors.length / rotors.mass if scaled else 0.0)
    full = model.scale * rotors.max_thrusts**model.exponent
    e, w = model.exponent, np.maximum(v, 0.0) * share
    slope = e * full * w ** (e - 1.0)
    bend = e * (e - 1.0) * full * np.maximum(w, _LEAST_THRUST) ** (e - 2.0)
    return Currents(
        value=full * w**e,
        by_v=slope * share,
        by_z=np.outer(slope * v, d_share),
        by_v_v=bend * share**2,
        by_v_z=np.outer(bend * share * v + slope, d_share),
        by_z_z=bend * v**2,
        d_share=d_share,
        by_mass=slope * v / rotors.mass if scaled else np.zeros(len(v)),
    )
