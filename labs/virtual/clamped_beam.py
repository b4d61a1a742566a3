"""A virtual laboratory for the clamped beam: recordings where no measured ones are at hand.

``python -m labs.virtual.clamped_beam examples/demo/virtual_beam`` wrote those that the demo takes
then.

Shares no code and as little physics as possible with the simulator that is fitted to it (numpy
and scipy only): a *beam* theory, not a solid; *modal* coordinates, not nodes; propagated by
*matrix exponentials*, not by an implicit step.

What it models
    - Bar: Timoshenko beam (shear, rotary inertia; interdependent-interpolation elements,
      Przemieniecki 1968 eq. 5.116), clamped, reduced to its lowest ``num_modes`` bending modes,
      once for the vertical and once for the lateral plane.
    - Rubber: generalized Maxwell solid, log-spaced relaxation times. It creeps by a few per cent
      per decade and has a nearly constant loss factor: stiffer in vibration than in its settled
      sag, by no one Young's modulus. A viscous share per mode stands for all other losses.
    - Weight: a mass under gravity on a string that can pull, not push. At release the tip falls
      away from it and the string goes slack until the weight has caught up.
    - Hand: holds the tip at zero height (a propped cantilever: the tip points up a little), then
      lets go within some milliseconds, not quite symmetrically: a lateral push, different in
      every repeat.
    - Markers: rigidly on the tip section (its height, slope and foreshortening); placed with an
      error against their nominal places; noise; rounding to 1 um; the tracker's settling in the
      first 0.15 s; the clamp's markers quiet but noisier.
    - Axes: the beam is inclined against the laboratory axes, as in the measured data.

What it does not model: large strains, contact, air, sideways motion of the weight.

The layout of the folder it writes is that of ``silicone_beam`` plus ``virtual: true`` and the
true parameters under ``truth``; a report made from it has to say so.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy import linalg

from diffsim.core.files import write_text_atomic
from labs.markers import Recording, format_csv

Array = NDArray[np.float64]

RATE_HZ = 100.0
SUBSTEP_S = 2.5e-4  # exact propagation; only slack/taut is decided at this spacing
NOMINAL_PLACE_M = {
    "tip1": (0.0, 0.015, 0.036),
    "tip2": (0.0, -0.006, 0.024),
    "tip3": (0.0, 0.036, 0.006),
    "base1": (-0.094, -0.01, -0.001),
    "base2": (-0.094, 0.04, 0.0275),
    "base3": (-0.094, 0.04, 0.0),
}


@dataclass(frozen=True, kw_only=True)
class VirtualBeam:
    """The hidden truth of the virtual laboratory, SI units.

    ``youngs_modulus`` is the fully relaxed one; the vibration sees it times about
    1 + ``relaxing_share`` (all branches slower than a cycle).
    """

    youngs_modulus: float = 290e3
    poissons_ratio: float = 0.499
    density: float = 1070.0
    length: float = 0.1
    width: float = 0.03
    height: float = 0.03
    gravity: float = 9.81
    relaxing_share: float = 0.16  # sum of the Maxwell branches over the relaxed modulus
    relaxation_times: tuple[float, ...] = (0.003, 0.03, 0.3, 3.0)
    viscous_ratio: float = 0.032  # of every mode, on top of the rubber's
    load_mass: float = 0.05202
    string_stiffness: float = 4e3  # N/m
    string_damping: float = 3.0  # N s/m
    weight_drag: float = 0.12  # N s/m, stands for friction where the weight hangs
    incline_deg: float = 6.6
    noise: float = 3e-6
    num_elements: int = 24
    num_modes: int = 4

    def __post_init__(self) -> None:
        if not -1.0 < self.poissons_ratio < 0.5:
            raise ValueError(f"poissons_ratio must lie in (-1, 0.5), got {self.poissons_ratio:g}")
        if not 1 <= self.num_modes <= self.num_elements:
            raise ValueError(
                f"num_modes must lie in [1, num_elements = {self.num_elements}], got "
                f"{self.num_modes}"
            )


@dataclass(frozen=True)
class _Modes:
    """Mass-normalized clamped-free bending modes."""

    omega: Array  # (n,) [rad/s], relaxed modulus
    tip_height: Array  # (n,) deflection of the tip per modal coordinate
    tip_slope: Array  # (n,)
    body_force: Array  # (n,) modal force of a unit acceleration field

    def sag(self, force: float, acceleration: float) -> float:
        """Static tip deflection under a tip force and a uniform acceleration."""
        modal = (self.tip_height * force + self.body_force * acceleration) / self.omega**2
        return float(self.tip_height @ modal)


def bending_modes(beam: VirtualBeam, height: float | None = None) -> _Modes:
    """Lowest modes of the Timoshenko cantilever; ``height`` is its size in the bending plane."""
    depth = beam.height if height is None else height
    across = beam.width if height is None else beam.width * beam.height / depth
    area, inertia = depth * across, across * depth**3 / 12.0
    nu, n = beam.poissons_ratio, beam.num_elements
    shear = beam.youngs_modulus / (2.0 * (1.0 + nu))
    kappa = 10.0 * (1.0 + nu) / (12.0 + 11.0 * nu)  # rectangle, Cowper 1966
    le = beam.length / n
    phi = 12.0 * beam.youngs_modulus * inertia / (kappa * shear * area * le**2)
    ei = beam.youngs_modulus * inertia / ((1.0 + phi) * le**3)
    k_el = ei * np.array(
        [
            [12, 6 * le, -12, 6 * le],
            [6 * le, (4 + phi) * le**2, -6 * le, (2 - phi) * le**2],
            [-12, -6 * le, 12, -6 * le],
            [6 * le, (2 - phi) * le**2, -6 * le, (4 + phi) * le**2],
        ]
    )
    m_el = (beam.density * area * le / 420.0) * np.array(
        [
            [156, 22 * le, 54, -13 * le],
            [22 * le, 4 * le**2, 13 * le, -3 * le**2],
            [54, 13 * le, 156, -22 * le],
            [-13 * le, -3 * le**2, -22 * le, 4 * le**2],
        ]
    ) + (beam.density * inertia / (30.0 * le)) * np.array(
        [
            [36, 3 * le, -36, 3 * le],
            [3 * le, 4 * le**2, -3 * le, -(le**2)],
            [-36, -3 * le, 36, -3 * le],
            [3 * le, -(le**2), -3 * le, 4 * le**2],
        ]
    )
    f_el = beam.density * area * np.array([le / 2, le**2 / 12, le / 2, -(le**2) / 12])
    size = 2 * (n + 1)
    stiffness, mass, force = np.zeros((size, size)), np.zeros((size, size)), np.zeros(size)
    for e in range(n):
        dofs = slice(2 * e, 2 * e + 4)
        stiffness[dofs, dofs] += k_el
        mass[dofs, dofs] += m_el
        force[dofs] += f_el
    free = slice(2, size)
    square, shapes = linalg.eigh(
        stiffness[free, free], mass[free, free], subset_by_index=[0, beam.num_modes - 1]
    )
    return _Modes(np.sqrt(square), shapes[-2], shapes[-1], shapes.T @ force[free])


class _Plane:
    """x' = A x + b u(t) of one bending plane: modal places, velocities, Maxwell branches.

    Mode i: q'' + 2 zeta w q' + w^2 (q + sum_j g_j (q - y_j)) = forces;  tau_j y_j' = q - y_j.
    """

    def __init__(self, modes: _Modes, beam: VirtualBeam, *, weight: float = 0.0):
        n, branches = len(modes.omega), len(beam.relaxation_times)
        self.modes, self.beam, self.n, self.weight = modes, beam, n, weight
        self.size = n * (2 + branches) + 2  # the last two: the weight's height and velocity
        share = beam.relaxing_share / branches
        q, v = np.arange(n), n + np.arange(n)
        a = np.zeros((self.size, self.size))
        a[q, v] = 1.0
        a[v, q] = -(modes.omega**2) * (1.0 + share * branches)
        a[v, v] = -2.0 * beam.viscous_ratio * modes.omega
        for j, tau in enumerate(beam.relaxation_times):
            y = n * (2 + j) + np.arange(n)
            a[v, y] = modes.omega**2 * share
            a[y, q], a[y, y] = 1.0 / tau, -1.0 / tau
        a[-2, -1] = 1.0
        a[-1, -1] = -beam.weight_drag / weight if weight > 0.0 else 0.0
        taut = a.copy()
        if weight > 0.0:
            k, c = beam.string_stiffness, beam.string_damping
            up = np.zeros(self.size)  # string force on the weight, pulling it up towards the tip
            up[q], up[v], up[-2], up[-1] = k * modes.tip_height, c * modes.tip_height, -k, -c
            taut[-1] += up / weight
            taut[v] -= np.outer(modes.tip_height, up)
            self.string = up
        self.dynamics = {False: a, True: taut}
        gravity = np.zeros(self.size)
        gravity[v] = -modes.body_force * beam.gravity
        gravity[-1] = -beam.gravity if weight > 0.0 else 0.0
        hand = np.zeros(self.size)
        hand[v] = modes.tip_height  # a unit force at the tip, upwards
        self.inputs = np.column_stack([gravity, hand])

    def held(self, height: float, acceleration: float = 1.0) -> tuple[Array, float]:
        """State at rest, branches relaxed, tip held at ``height``; and the hand's force."""
        modes, x = self.modes, np.zeros(self.size)
        load = self.weight * self.beam.gravity * acceleration
        field = self.beam.gravity * acceleration
        force = (height + modes.sag(load, field)) / modes.sag(1.0, 0.0)
        q = (modes.tip_height * (force - load) - modes.body_force * field) / modes.omega**2
        for block in range(2 + len(self.beam.relaxation_times)):
            if block != 1:  # velocities stay zero
                x[block * self.n : (block + 1) * self.n] = q
        if self.weight > 0.0:
            x[-2] = height - load / self.beam.string_stiffness
        return x, force

    def tip(self, x: Array) -> tuple[Array, Array]:
        """Height and slope of the tip from states (..., size)."""
        q = x[..., : self.n]
        return q @ self.modes.tip_height, q @ self.modes.tip_slope

    def run(self, x: Array, hand: Array, steps_per_frame: int, *, gravity: float = 1.0) -> Array:
        """States at frames, (len(hand) // steps_per_frame, size)."""
        step = {}
        for taut, a in self.dynamics.items():
            # exp of [[A, B], [0, 0]] h: exact for inputs held over a substep
            block = np.zeros((self.size + 2, self.size + 2))
            block[: self.size, : self.size] = a
            block[: self.size, self.size :] = self.inputs
            e = linalg.expm(block * SUBSTEP_S)
            step[taut] = (e[: self.size, : self.size], e[: self.size, self.size :])
        frames = []
        for i, force in enumerate(hand):
            if i % steps_per_frame == 0:
                frames.append(x)
            taut = self.weight > 0.0 and float(self.string @ x) > 0.0
            a, b = step[taut]
            x = a @ x + b @ np.array([gravity, force])
        return np.array(frames)


def record(
    beam: VirtualBeam, *, loaded: bool, duration_s: float, rng: np.random.Generator
) -> tuple[Recording, dict[str, object]]:
    """One trial: hold, release, settle.

    Returns:
        The recording in laboratory axes, and its entry for ``metadata.yaml``.
    """
    release_s = 0.55 + 0.25 * rng.random()
    letting_go = rng.uniform(0.004, 0.012)  # the hand's force fades over this time
    steps = round(1.0 / RATE_HZ / SUBSTEP_S)
    num_frames = round(duration_s * RATE_HZ)
    t = np.arange(num_frames * steps) * SUBSTEP_S
    fade = np.clip(1.0 - (t - release_s) / letting_go, 0.0, 1.0)

    weight = beam.load_mass if loaded else 0.0
    vertical = _Plane(bending_modes(beam), beam, weight=weight)
    x0, force = vertical.held(0.0)
    down = vertical.run(x0, force * fade, steps)
    lateral = _Plane(bending_modes(beam, height=beam.width), beam)
    push = rng.normal(0.0, 0.5e-3 if loaded else 0.3e-3)
    y0, side = lateral.held(push, acceleration=0.0)
    sideways = lateral.run(y0, side * fade, steps, gravity=0.0)

    height, pitch = vertical.tip(down)
    swing, yaw = lateral.tip(sideways)
    markers = {name: np.array(place) for name, place in NOMINAL_PLACE_M.items()}
    center = np.array([0.0, beam.width / 2, beam.height / 2])
    place = np.empty((num_frames, len(markers), 3))
    for i, (name, nominal) in enumerate(markers.items()):
        at = nominal + rng.normal(0.0, 0.4e-3, 3)  # nobody glues a marker to 0.1 mm
        if name.startswith("tip"):
            arm = at - center
            # slope > 0 lifts the nose: points above the axis move back; chord shortens by
            # about 0.6 d^2 / L for a cantilever's shape
            back = -0.6 * (height**2 + swing**2) / beam.length
            place[:, i, 0] = at[0] + back - arm[2] * np.sin(pitch) - arm[1] * np.sin(yaw)
            place[:, i, 1] = at[1] + swing + arm[1] * (np.cos(yaw) - 1) + arm[0] * np.sin(yaw)
            place[:, i, 2] = at[2] + height + arm[2] * (np.cos(pitch) - 1) + arm[0] * np.sin(pitch)
            place[:, i] += rng.normal(0.0, beam.noise, (num_frames, 3))
        else:
            place[:, i] = at + rng.normal(0.0, 3.0 * beam.noise, (num_frames, 3))
            settling = np.arange(num_frames) / RATE_HZ < 0.12
            place[settling, i] += rng.normal(0.0, 2e-4, 3)
    angle = np.radians(beam.incline_deg)
    to_model = np.array(  # laboratory -> model
        [
            [np.cos(angle), 0.0, -np.sin(angle)],
            [0.0, 1.0, 0.0],
            [np.sin(angle), 0.0, np.cos(angle)],
        ]
    )
    offset = np.array([-0.065, 0.048, -0.046])
    recording = Recording(
        time_s=np.arange(num_frames) / RATE_HZ,
        position_m=np.round((place - offset) @ to_model, 6),  # rows: rot' (p - offset)
        markers=tuple(markers),
    )
    moved = np.linalg.norm(place[:, :3].mean(1) - place[20:35, :3].mean((0, 1)), axis=1)
    entry = {
        "tip_load_N": weight * beam.gravity,
        "tip_load_mass_kg": weight,
        "frames": num_frames,
        "duration_s": duration_s,
        "release_frame_detected": int(np.argmax(moved > 0.05 * moved[-100:].mean())),
        "data_to_model_rotation": to_model.round(6).tolist(),
        "data_to_model_translation_m": offset.tolist(),
        "truth_release_s": float(release_s),
    }
    return recording, entry


def write_beam_study(folder: str | Path, beam: VirtualBeam | None = None, seed: int = 0) -> Path:
    """Make the four recordings (two cases, two repeats) and their metadata.

    Args:
        folder: Written to; existing files of the same names are replaced.
        beam: Bar whose parameters the recordings hide; None: the default one.
        seed: Seed of the hand's motion, the marker placement and the noise.

    Returns:
        ``folder``.
    """
    beam, folder = beam or VirtualBeam(), Path(folder)
    rng = np.random.default_rng(seed)
    entries = []
    for case, loaded, duration_s in (("gravity", False, 5.0), ("load52", True, 6.0)):
        for repeat in "ab":
            recording, entry = record(beam, loaded=loaded, duration_s=duration_s, rng=rng)
            file = f"{case}_{repeat}.csv"
            write_text_atomic(folder / file, format_csv(recording))
            entries.append({"file": file, **entry})
    metadata = {
        "name": "virtual_beam",
        "virtual": True,
        "title": "VIRTUAL clamped beam: computed by labs.virtual.clamped_beam, not measured",
        "seed": seed,
        "truth": {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(beam).items()},
        "sampling": {"rate_Hz": RATE_HZ, "device": "virtual"},
        "geometry": {
            "length_m": beam.length,
            "width_m": beam.width,
            "height_m": beam.height,
            "nominal_marker_position_in_model_frame_m": {
                name: list(place) for name, place in NOMINAL_PLACE_M.items()
            },
        },
        "material": {
            "name": "virtual rubber",
            "density_kg_m3": beam.density,
            "poisson_ratio": beam.poissons_ratio,
            "youngs_modulus_Pa_used_by_authors": 263824.0,
            "gravity_m_s2_used_by_authors": beam.gravity,
        },
        "trials": entries,
    }
    write_text_atomic(folder / "metadata.yaml", yaml.safe_dump(metadata, sort_keys=False))
    return folder


if __name__ == "__main__":
    write_beam_study(sys.argv[1])
