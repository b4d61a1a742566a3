"""Designs for the tests of co-design, made of point masses and rods that depend linearly on s."""

import json
from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg import null_space

from diffsim.copter import Multicopter
from tests.measured import data_folder

ROD = 0.0650543  # [kg/m]
DOUBLE = torch.float64


@dataclass
class LinearDesign:
    """Parts of mass base_mass + mass_rate @ s at center base + map @ s; rotors likewise.

    masses: (n_parts,), mass_rates (n_parts, p); centers (n_parts, 3), center_maps (n_parts, 3, p);
    rotors (n, 3), rotor_maps (n, 3, p).
    """

    names: list
    values: torch.Tensor
    A: torch.Tensor
    b: torch.Tensor
    masses: torch.Tensor
    mass_rates: torch.Tensor
    centers: torch.Tensor
    center_maps: torch.Tensor
    rotors: torch.Tensor
    rotor_maps: torch.Tensor
    length_rate: torch.Tensor
    length: float
    facts: dict
    calls: int = 0

    @property
    def inequalities(self):
        return self.A, self.b

    def multicopter(self, s, directions=None, spins=None):
        self.calls += 1
        m = self.masses + self.mass_rates @ s
        x = self.centers + self.center_maps @ s
        com = (m[:, None] * x).sum(0) / m.sum()
        r = x - com
        outer = (r * r).sum(-1)[:, None, None] * torch.eye(3, dtype=DOUBLE) - r[:, :, None] * r[
            :, None
        ]
        inertia = (m[:, None, None] * outer).sum(0) + 1e-4 * torch.eye(3, dtype=DOUBLE)
        facts = self.facts
        if directions is None:
            directions = facts["directions"]
        return Multicopter(
            mass=m.sum(),
            inertia=inertia,
            positions=self.rotors + self.rotor_maps @ s - com,
            directions=directions,
            spins=facts["spins"] if spins is None else spins,
            torque_ratios=facts["torque_ratios"],
            max_thrusts=facts["max_thrusts"],
            radii=facts["radii"],
        )

    def size(self, s):
        return self.length + self.length_rate @ s

    def cost(self, s):
        return 300.0 + 25.0 * self.size(s)


def tensor(x):
    return torch.as_tensor(np.asarray(x, float), dtype=DOUBLE)


def rotor_facts(rotors, radius):
    n = len(rotors)
    sign = np.array([-1.0 if r["flip"] else 1.0 for r in rotors])
    ccw = np.array([r["is_ccw"] for r in rotors], float)
    return {
        "directions": tensor([[0.0, 0.0, -1.0]] * n),
        "spins": tensor(sign * (1.0 - 2.0 * ccw)),
        "torque_ratios": tensor([r["torque_to_thrust"] for r in rotors]),
        "max_thrusts": tensor([r["max_thrust"] for r in rotors]),
        "radii": tensor([radius] * n),
    }


def reference_design(name):
    """The public tool's design as it parametrizes it: A x = b and C x <= d on full parameters."""
    folder = data_folder("copter_reference")
    space = json.loads((folder / "reference_design_constraints.json").read_text())["copters"][name]
    copter = json.loads((folder / "reference_copters.json").read_text())["copters"][name]
    columns = {key: i for i, key in enumerate(space["names"])}
    x0, count = np.array(space["x0"]), len(columns)

    def dense(entries, rows):
        matrix = np.zeros((rows, count))
        for row, column, value in entries:
            matrix[row, column] = value
        return matrix

    equal = dense(space["A"], len(space["b"]))
    basis = null_space(equal, rcond=1e-9)
    assert basis.shape[1] == space["nullity"]
    unequal, limit = dense(space["C"], len(space["d"])), np.array(space["d"])
    # short names of one rotor's, connector's or tube's position
    masses, rates, centers, maps = [], [], [], []
    seen = {"tube": 0, "connector": 0, "motor": 0}
    lengths = np.zeros(count)
    for part in copter["components"]:
        kind = part["type"]
        center, rate, mass = np.zeros((3, count)), np.zeros(count), part["mass"]
        if kind in seen:
            key = f"{'rotor' if kind == 'motor' else kind}_{seen[kind]}"
            seen[kind] += 1
            for axis in range(3):
                center[axis, columns[f"{key}:{axis}"]] = 1.0
            if kind == "tube":
                length = columns[f"{key}:3"]
                rate[length] = mass / x0[length]
                lengths[length] = 1.0
        masses.append(mass - rate @ x0)
        rates.append(rate @ basis)
        centers.append(part["com_world"])
        maps.append(center @ basis)
        masses[-1] = mass
    n = len(copter["rotors"])
    rotor_maps = np.zeros((n, 3, count))
    for i in range(n):
        for axis in range(3):
            rotor_maps[i, axis, columns[f"rotor_{i}:{axis}"]] = 1.0
    com = np.array(copter["com_world"])
    return LinearDesign(
        names=[f"free_{i}" for i in range(basis.shape[1])],
        values=torch.zeros(basis.shape[1], dtype=DOUBLE),
        A=tensor(unequal @ basis),
        b=tensor(limit - unequal @ x0),
        masses=tensor(masses),
        mass_rates=tensor(rates),
        centers=tensor(centers),
        center_maps=tensor(maps),
        rotors=tensor([np.array(r["pos_body"]) + com for r in copter["rotors"]]),
        rotor_maps=tensor(rotor_maps @ basis),
        length_rate=tensor(lengths @ basis),
        length=float(lengths @ x0),
        facts=rotor_facts(copter["rotors"], 0.1778 if name == "pentacopter" else 0.127),
    )


def arm_copter(angles, arm=0.25, *, free_positions=False, body=(0.05, 0.0, 0.0), **changes):
    """Rotors on rods from the origin; parameters are arm lengths, or all x and y (in a box)."""
    n = len(angles)
    ways = np.stack([np.cos(angles), np.sin(angles), np.zeros(n)], -1)
    p = 2 * n if free_positions else n
    maps = np.zeros((n, 3, p))
    for i in range(n):
        if free_positions:
            maps[i, 0, 2 * i] = maps[i, 1, 2 * i + 1] = 1.0
        else:
            maps[i, :, i] = ways[i]
    values = (arm * ways[:, :2]).ravel() if free_positions else np.full(n, arm)
    low, high = (-0.4, 0.4) if free_positions else (0.0, 0.5)
    rods = np.zeros((n, p)) if free_positions else np.eye(n)
    facts = {
        "directions": tensor([[0.0, 0.0, -1.0]] * n),
        "spins": tensor([(-1.0) ** i for i in range(n)]),
        "torque_ratios": tensor([0.0147] * n),
        "max_thrusts": tensor([7.2] * n),
        "radii": tensor([0.127] * n),
    } | {key: tensor(value) for key, value in changes.items()}
    return LinearDesign(
        names=[f"arm_{i}" for i in range(p)],
        values=tensor(values),
        A=tensor(np.vstack([np.eye(p), -np.eye(p)])),
        b=tensor([high] * p + [-low] * p),
        masses=tensor([0.6] + [0.1] * n + [0.0] * n),
        mass_rates=tensor(np.vstack([np.zeros((n + 1, p)), ROD * rods])),
        centers=tensor(np.vstack([[body], np.zeros((2 * n, 3))])),
        center_maps=tensor(np.concatenate([np.zeros((1, 3, p)), maps, 0.5 * maps])),
        rotors=tensor(np.tile([0.0, 0.0, -0.03], (n, 1))),
        rotor_maps=tensor(maps),
        length_rate=tensor(rods.sum(0)),
        length=0.0,
        facts=facts,
    )
