"""A rod that two tendons bend, as a rig: equilibria by shooting along its arc length.

The model that is fitted solves for the strains of a few elements; here the balance of forces and
moments of the same rod is integrated from base to tip, and Newton's method looks for the moment at
the base that leaves none at the tip.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffsim.data.study import Channel, Run, Study
from labs.rates.rig import Cause, Recorded, Size
from labs.rates.troubles import TAILS, with_noise

Array = NDArray[np.float64]
Slopes = Callable[[float, Array], Array]
LENGTH, RADIUS, DISTANCE = 0.3, 0.008, 0.005
MODULUS, DENSITY, POISSON, SHEAR = 8e5, 1100.0, 0.45, 0.9
ANGLES = {"first": 0.5, "second": 2.4}  # of the tendons around the axis, from local y to z
MARKERS = {"middle": 0.16, "tip": LENGTH}
NOISE = 3e-4
MOST_N = 0.8  # tension
GRAVITY = (0.0, 0.0, -9.81)
STEPS = 90  # of Runge and Kutta along the rod; markers lie at multiples of them
ROUNDS = 4  # each gains about two digits
MOST_SHOTS, BESIDE, CLOSED = 20, 1e-5, 1e-9  # moments [N m]
FIRST = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])  # columns: along, y, z
STILL = {
    "drive_loss": (0.0,), "pretension": (0.0,), "tendon_distance": (0.0,), "radius_offset": (0.0,),
    "rest_bend": (0.0, 0.0), "gravity_tilt": (0.0, 0.0), "tip_mass": (0.0,), "magnet": (0.0,),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class RodBalance:
    """A rod under two tensions, with what is wrong about it."""

    modulus: float  # Young's modulus [Pa]
    density: float  # [kg/m^3]
    hidden: Mapping[str, Size]  # sizes of causes; zeros where none is hidden

    def markers(self, tensions: Array) -> Array:
        """Places of the markers, (num_poses, 3 num_markers), under tensions (num_poses, 2) [N]."""
        size = {**STILL, **self.hidden}
        pulls = np.maximum(np.maximum(tensions - size["drive_loss"][0], 0.0), size["pretension"][0])
        moment = np.zeros((len(pulls), 3))
        for _ in range(MOST_SHOTS):
            # the shot itself and one beside it along each axis, in one batch
            tried = np.concatenate([moment, *(moment + BESIDE * axis for axis in np.eye(3))])
            ends, seen = self._shot(tried, np.tile(pulls, (4, 1)), size)
            ends = ends.reshape(4, len(pulls), 3)
            slopes = np.moveaxis(ends[1:] - ends[0], 0, -1) / BESIDE
            if np.abs(ends[0]).max() < CLOSED:
                return seen[: len(pulls)]
            moment = moment - np.linalg.solve(slopes, ends[0][..., None])[..., 0]
        raise RuntimeError(f"rod: no equilibrium within {MOST_SHOTS} shots")

    def _shot(self, moment: Array, pulls: Array, size: Mapping[str, Size]) -> tuple[Array, Array]:
        """Moment that is left at the tip, and the markers, from a moment at the base."""
        slope = self._slopes(pulls, size)
        count = len(moment)
        state = np.concatenate(
            [np.zeros((count, 3)), np.tile(FIRST.ravel(), (count, 1)), moment], axis=1
        )
        h, seen = LENGTH / STEPS, []
        at = [round(place / h) for place in MARKERS.values()]
        for k in range(STEPS):
            s = k * h
            one = slope(s, state)
            two = slope(s + h / 2, state + h / 2 * one)
            three = slope(s + h / 2, state + h / 2 * two)
            four = slope(s + h, state + h * three)
            state = state + h / 6 * (one + 2 * two + 2 * three + four)
            if k + 1 in at:
                seen.append(state[:, :3])
        return state[:, 12:], np.concatenate(seen, axis=1)

    def _slopes(self, pulls: Array, size: Mapping[str, Size]) -> Slopes:
        radius = RADIUS + size["radius_offset"][0]
        area = np.pi * radius**2
        bend = self.modulus * area * radius**2 / 4.0
        shear = 0.5 / (1.0 + POISSON)
        stiff = np.array([2.0 * shear * bend, bend, bend])
        axial = self.modulus * area * np.array([1.0, SHEAR * shear, SHEAR * shear])
        gravity = Rotation.from_rotvec([*size["gravity_tilt"], 0.0]).apply(GRAVITY)
        toward_y, toward_z = size["rest_bend"]
        rest, straight = np.array([0.0, -toward_z, toward_y]), np.array([1.0, 0.0, 0.0])
        away = DISTANCE + size["tendon_distance"][0]
        arms = [away * np.array([0.0, np.cos(a), np.sin(a)]) for a in ANGLES.values()]

        def slope(s: float, state: Array) -> Array:
            turn, moment = state[:, 3:12].reshape(-1, 3, 3), state[:, 12:]
            weight = (self.density * area * (LENGTH - s) + size["tip_mass"][0]) * gravity
            beyond = weight + np.array([size["magnet"][0], 0.0, 0.0])
            beyond = np.broadcast_to(beyond, (len(state), 3))
            local, m = np.einsum("bij,bi->bj", turn, beyond), np.einsum("bij,bi->bj", turn, moment)
            u, v = np.tile(rest, (len(state), 1)), np.tile(straight, (len(state), 1))
            for _ in range(ROUNDS):  # tendons lie along what they bend
                n, left = local.copy(), m.copy()
                for pull, arm in zip(pulls.T, arms, strict=True):
                    along = v + np.cross(u, arm)
                    force = (pull / np.linalg.norm(along, axis=1))[:, None] * along
                    n -= force
                    left -= np.cross(arm, force)
                u = rest + left / stiff
                v = straight + n / axial
            way = np.einsum("bij,bj->bi", turn, v)
            # the rows of a rotation turn against the bend, seen from the section
            turning = np.cross(turn, u[:, None, :])
            return np.concatenate([way, turning.reshape(-1, 9), -np.cross(way, beyond)], axis=1)

        return slope


@dataclass(frozen=True)
class RodRig:
    """A silicone rod that hangs from its clamp."""

    name: str = "rod"
    setup_file: Path | None = None
    disturbances: tuple[str, ...] = (TAILS,)

    @property
    def causes(self) -> Mapping[str, Cause]:
        """What it can hide; a magnet that pulls the tip sideways is in no library."""
        return {
            "drive_loss": Cause(0.03, most=0.3),
            "pretension": Cause(0.05, most=0.3),
            "tendon_distance": Cause(5e-4, signed=True, most=2e-3),
            "rest_bend": Cause(0.1, signed=True, components=2, most=4.0),
            "gravity_tilt": Cause(0.02, signed=True, components=2, most=0.5),
            "tip_mass": Cause(1e-3, signed=False, most=0.03),
            "radius_offset": Cause(2e-4, signed=True, most=1.5e-3),
            "magnet": Cause(2e-3, signed=True, known=False, most=0.1),
        }

    def record(self, seed: int, hidden: Mapping[str, Size], disturbance: str) -> Recorded:
        """Poses under one tendon, the other, and both; mixtures for the test."""
        rng, noise = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(2))
        z = np.clip(rng.standard_normal(2), -1.5, 1.5)
        base = {"youngs_modulus": MODULUS * np.exp(0.1 * z[0]), "density": DENSITY}
        base["density"] *= float(np.exp(0.03 * z[1]))
        rod = RodBalance(base["youngs_modulus"], base["density"], hidden)
        channels = tuple(
            Channel(f"{marker}_{axis}_m", "m", "position", NOISE)
            for marker in MARKERS
            for axis in "xyz"
        )
        poses = _poses(rng)
        shown = np.split(rod.markers(np.concatenate([p for _, _, p in poses])), len(poses))
        runs, clean = [], []
        for order, ((name, use, tensions), seen) in enumerate(zip(poses, shown, strict=True)):
            command = {f"{n}_N": tensions[:, k] for k, n in enumerate(ANGLES)}
            run = Run(name, np.arange(float(len(seen))), seen, command, name, order, use)
            noisy, exact = with_noise(noise, run, channels, disturbance)
            runs.append(noisy)
            clean.append(exact)
        study = Study(self.name, "rod", channels, tuple(runs), model=MODEL)
        whole = Study(self.name, "rod", channels, tuple(clean), model=MODEL)
        return Recorded(study, whole, {k: float(v) for k, v in base.items()})


def _poses(rng: np.random.Generator) -> list[tuple[str, str, Array]]:
    """Name, use and tensions, (num_poses, 2), of each run."""
    levels = MOST_N * np.array([0.15, 0.4, 0.65, 0.9]) * (0.9 + 0.2 * rng.random())
    none = np.zeros(4)
    mixed = MOST_N * (0.2 + 0.6 * rng.random((4, 2)))
    return [
        ("first_a", "fit", np.column_stack([levels, none])),
        ("second_a", "fit", np.column_stack([none, levels])),
        ("both_a", "fit", np.column_stack([levels, levels[::-1]])),
        ("first_b", "fit", np.column_stack([levels, none])),
        ("second_b", "fit", np.column_stack([none, levels])),
        ("both_b", "fit", np.column_stack([levels, levels[::-1]])),
        ("mixed", "test", mixed),
    ]


MODEL: dict[str, Any] = {
    "system": "rod",
    "stations": [{"at": 0.0, "radius": RADIUS}, {"at": LENGTH, "radius": RADIUS}],
    "material": {
        "youngs_modulus": {"value": MODULUS, "percent": 15},
        "poissons_ratio": POISSON,
        "density": {"value": DENSITY, "percent": 4},
    },
    "base": {"along": [0.0, 0.0, -1.0], "across": [1.0, 0.0, 0.0]},
    "tendons": [
        {
            "name": name,
            "command": f"{name}_N",
            "path": [
                {"at": 0.0, "angle": angle, "distance": DISTANCE},
                {"at": LENGTH, "angle": angle, "distance": DISTANCE},
            ],
        }
        for name, angle in ANGLES.items()
    ],
    "markers": {name: {"at": at} for name, at in MARKERS.items()},
}
ROD = (RodRig(),)
