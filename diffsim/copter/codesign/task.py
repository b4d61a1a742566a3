"""A co-design task: the design's fast copy, what is asked of it, and programs made from both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.copter.codesign.cases import Demands, flight_cases
from diffsim.copter.codesign.hover import LEVEL, guess_thrusts
from diffsim.copter.codesign.limits import Limits, Scales
from diffsim.copter.codesign.metrics import CurrentModel, parse_objective, require_currents
from diffsim.copter.codesign.program import Program
from diffsim.copter.codesign.solve import LocalSolution, solve_local
from diffsim.copter.codesign.space import DesignSpace, ShapeModel
from diffsim.copter.codesign.wrench import Rotors
from diffsim.copter.vehicle.multicopter import GRAVITY, Multicopter
from diffsim.core.arrays import Array


@dataclass(frozen=True)
class Point:
    """A candidate: shape, directions, spins and gravity's direction in the body frame."""

    s: Array  # (num_params,)
    d: Array  # (n_rotors, 3)
    spins: Array  # (n_rotors,)
    gamma: Array  # (3,)

    @staticmethod
    def of(program: Program, x: Array, spins: Array) -> Point:
        """The candidate of a program's unknowns."""
        s, d, gamma, _, _ = program.split(x)
        return Point(s, d, spins, gamma)


@dataclass(frozen=True)
class Task:
    """What is optimized, and within which limits."""

    design: DesignSpace
    model: ShapeModel
    weights: dict[str, float]
    demands: Demands
    limits: Limits
    scales: Scales
    currents: CurrentModel | None

    @staticmethod
    def of(
        design: DesignSpace,
        objective: str | Mapping[str, float],
        demands: Demands,
        limits: Limits,
        currents: CurrentModel | None,
    ) -> Task:
        """Checked and scaled by the design as it stands."""
        weights = parse_objective(objective)
        model = ShapeModel(design)
        currents = require_currents(weights, currents, model.num_rotors)
        scales = _scales(model, currents, demands)
        return Task(design, model, weights, demands, limits, scales, currents)

    @property
    def rotors(self) -> Rotors:
        """Constants of the rotors with the design's own spins."""
        return self.program(self.model.vehicle.spins.numpy()).rotors

    @property
    def start(self) -> Point:
        """The design as it stands, level."""
        vehicle = self.model.vehicle
        return Point(self.model.start, vehicle.directions.numpy(), vehicle.spins.numpy(), LEVEL)

    def program(self, spins: Array, free: Sequence[str] | None = None) -> Program:
        """The nonlinear program of one spin assignment."""
        limits = self.limits if free is None else replace(self.limits, free=tuple(free))
        bare = Program(self.model, spins, self.weights, [], limits, self.scales, self.currents)
        cases = flight_cases(self.weights, self.demands, bare.rotors, bare.radii)
        return Program(self.model, spins, self.weights, cases, limits, self.scales, self.currents)

    def first_unknowns(self, program: Program, point: Point) -> Array:
        """All unknowns at a point: thrusts as near to balance as bounds allow."""
        shape = self.model.at(point.s)
        aux = {"authority": 0.1, "response": 0.1, "payload": 0.5}
        guesses = [
            guess_thrusts(
                case, shape, point.d, point.gamma, program.rotors, aux.get(case.aux or "", 1.0)
            )
            for case in program.cases
        ]
        v = np.stack(guesses)
        for name in ("payload", "one_rotor_out"):
            used = [c for c, case in enumerate(program.cases) if case.cap == name]
            aux[name] = float(v[used].max()) if used else 1.0
        if "max_current" in program.aux:
            current = program.hover_currents(point.s, v[0]).value
            aux["max_current"] = float(current.max() / self.scales.max_current)
        return program.pack(point.s, point.d, point.gamma, aux, v)

    def solve(
        self, point: Point, *, free: Sequence[str] | None = None, **options: Any
    ) -> tuple[LocalSolution, Program]:
        """A local solve from a point with its spins."""
        program = self.program(point.spins, free)
        start = self.first_unknowns(program, point)
        return solve_local(program, start, **options), program

    def lifting(self, load: bool = True) -> Task:
        """The same design asked for payload alone, with the demanded authority if ``load``."""
        demands = self.demands if load else replace(self.demands, authority=None)
        return replace(self, weights={"payload": 1.0}, demands=demands)

    def vehicle(self, point: Point) -> Multicopter:
        """The whole model of a point, not the fast copy."""
        as_tensor = (torch.as_tensor(np.array(a)) for a in (point.s, point.d, point.spins))
        return self.design.multicopter(*as_tensor).detach()


def _scales(model: ShapeModel, currents: CurrentModel | None, demands: Demands) -> Scales:
    """Metrics of the start; its weight spread over the rotors by their limits stands for hover."""
    shape = model.at(model.start)
    top = model.vehicle.max_thrusts.numpy()
    share = top * min(shape.mass * GRAVITY / top.sum(), 1.0)
    current = currents.current(share) if currents is not None else np.ones(len(top))
    inertia = float(model.vehicle.inertia.diagonal().max())
    return Scales(
        current=float(current.sum()),
        max_current=float(current.max()),
        size=_size_of(abs(shape.size)),
        cost=_size_of(abs(shape.cost)),
        mass=shape.mass,
        inertia=inertia,
        response=4.0 * demands.response_angle * inertia / (shape.mass * GRAVITY * model.length),
    )


def _size_of(value: float) -> float:
    return value if value > 1e-9 else 1.0


def hover_residual(vehicle: Multicopter, thrusts: Tensor, gamma: Array) -> float:
    """Largest imbalance of force over m g and of torque over m g times mean arm, from the model."""
    weight = float(vehicle.weight)
    arm = max(float(vehicle.positions.norm(dim=-1).mean()), 1e-3)
    force = vehicle.force_matrix @ thrusts + weight * torch.as_tensor(np.array(gamma))
    torque = vehicle.torque_matrix @ thrusts
    return max(float(force.abs().max()) / weight, float(torque.abs().max()) / (weight * arm))
