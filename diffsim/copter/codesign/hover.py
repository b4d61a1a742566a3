"""How much a given multicopter lifts: reach of spin assignments, and first guesses of thrusts."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog, lsq_linear

from diffsim.copter.codesign.space import Shape
from diffsim.copter.codesign.wrench import Case, Rotors
from diffsim.core.arrays import Array

LEVEL = np.array([0.0, 0.0, 1.0])  # direction of gravity in the body frame of a level body
_MAX_ENUMERATED = 12  # rotors: 4096 assignments


def effect(
    shape: Shape, d: Array, rotors: Rotors, spins: Array, torque_ratios: Array
) -> tuple[Array, Array]:
    """Relative thrusts to relative lift (n,) and torque (3, n) of a level body."""
    torque = np.cross(shape.positions, d) + (spins * torque_ratios)[:, None] * d
    lift = -d @ LEVEL * rotors.max_thrusts / rotors.weight
    return lift, torque.T * rotors.max_thrusts / (rotors.weight * rotors.length)


def reach(lift: Array, torque: Array) -> float:
    """Largest weight that a level body lifts without torque, over m0 g; 0 if none (an LP)."""
    solution = linprog(-lift, A_eq=torque, b_eq=np.zeros(3), bounds=(0.0, 1.0))
    return float(-solution.fun) if solution.status == 0 else 0.0


@dataclass(frozen=True)
class SpinChoice:
    """One spin assignment and the weight that it lifts at the start, over m0 g."""

    spins: tuple[float, ...]
    reach: float


def rank_spins(shape: Shape, d: Array, rotors: Rotors, torque_ratios: Array) -> list[SpinChoice]:
    """All 2^n spin assignments, those that lift most first (ties: in binary order).

    Raises:
        ValueError: too many rotors to enumerate.
    """
    n = len(d)
    if n > _MAX_ENUMERATED:
        raise ValueError(
            f"spins of {n} rotors cannot be enumerated (2^{n}); give spins, or 'given' to keep "
            f"those of the design (at most {_MAX_ENUMERATED} rotors are searched)"
        )
    choices = []
    for signs in itertools.product((1.0, -1.0), repeat=n):
        lift, torque = effect(shape, d, rotors, np.array(signs), torque_ratios)
        choices.append(SpinChoice(signs, reach(lift, torque)))
    # rounded, or equal assignments would be ordered by the LP's rounding
    return sorted(choices, key=lambda choice: -round(choice.reach, 9))


def guess_thrusts(
    case: Case, shape: Shape, d: Array, gamma: Array, rotors: Rotors, aux: float
) -> Array:
    """Relative thrusts within bounds that come closest to a case's balance, (n,)."""
    torque = np.cross(shape.positions, d) + rotors.reaction[:, None] * d
    torque = torque.T * rotors.max_thrusts / (rotors.weight * rotors.length)
    force = d.T * rotors.max_thrusts / rotors.weight
    weight, _ = case.weight(shape, rotors)
    if case.lift_only:
        force, target = gamma[None] @ force, np.array([-weight])
    else:
        target = -weight * gamma
    rows = np.vstack([force, torque[list(case.axes)]])
    wanted = np.concatenate([target, aux * np.array(case.torque)[list(case.axes)]])
    top = np.ones(len(d))
    if case.dead_rotor is not None:
        top[case.dead_rotor] = 1e-9
    return np.clip(lsq_linear(rows, wanted, bounds=(0.0, top), method="bvls").x, 0.0, 1.0)
