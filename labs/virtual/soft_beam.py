"""Virtual laboratory of a clamped bar of silicone foam, bent to one side by a tendon.

A tendon runs along the bar, off its axis, and is anchored at the tip: tension times offset is a
moment at the tip. Bending in a horizontal plane; no gravity. Beam theory in modal coordinates,
propagated by exponentials with a second-order correction for what is not linear (ETD2RK, Cox and
Matthews 2002); friction, dead band and backlash are sharp.

Not modeled: finite rotations (the tip moves by some per cent of the length), axial
compression by the tendon.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, ClassVar

import numpy as np
from scipy import linalg

from diffsim.data.study import Channel
from labs.virtual.beam_modes import Array, BeamModes, BeamShape, beam_modes
from labs.virtual.common import Base, Lab, LabEffect, Plan, delayed, size_of

RATE_HZ, DURATION_S = 100.0, 1.6
SUBSTEPS = 20  # per sample: 0.5 ms
TENDON_OFFSET_M = 1.2e-3
WATER_KG_M3 = 1000.0
MAX_TENSION_N = 1.6
# Branches of the constant loss: four a decade from 0.3 to 100 Hz (the library has other ones).
LOSS_TAU_S = 1.0 / (2.0 * np.pi * 0.3 * np.logspace(0.0, 2.5, 11))
STOP_M = 0.003  # where the stop outside the library stands
SD_M = 100e-6  # of a plain camera half a meter away
MARKERS_M = {"tip_y_m": 0.145, "mid_y_m": 0.075}


class SoftBeamLab(Lab):
    """See the module; channels are displacements sideways of the tip and of mid-length."""

    system: ClassVar[str] = "soft_body"
    channels: ClassVar[tuple[Channel, ...]] = tuple(
        Channel(name, "m", "position", SD_M) for name in MARKERS_M
    )
    base: ClassVar[dict[str, Base]] = {
        "youngs_modulus": Base(280e3, 0.10, "Pa"),
        "rayleigh_beta": Base(1.5e-3, 0.30, "s"),
    }
    effects: ClassVar[dict[str, LabEffect]] = {
        "stiffness_damping": LabEffect("s", 1e-3, "-eta K v on top of rayleigh_beta"),
        "loss_factor": LabEffect("-", 0.03, "the same loss from 0.3 to 100 Hz, 2 zeta"),
        "volume_drag": LabEffect("N s/m^4", 1e3, "-c v per volume"),
        "quadratic_volume_drag": LabEffect("N s^2/m^5", 1.5e4, "-c |v| v per volume"),
        "current": LabEffect("m/s", 0.03, "drag 2e4 N s^2/m^5 |v - U| (v - U)", outside=True),
        "added_mass": LabEffect("-", 0.05, "C_a times the mass of displaced water"),
        "tilt": LabEffect("m/s^2", 0.1, "constant acceleration sideways, before the start, too"),
        "dry_friction": LabEffect("N", 5e-4, "Coulomb friction at the tip"),
        "stiffening": LabEffect("-", 400.0, "stress E (1 + k strain^2) strain"),
        "temperature_drift": LabEffect("-", 0.003, "E (1 + alpha order)"),
        "delay": LabEffect("s", 0.006, "tension late by a dead time"),
        "lag": LabEffect("s", 0.006, "first-order lag of the tension"),
        "tension_dead_band": LabEffect("N", 0.04, "the first newtons are slack"),
        "tension_backlash": LabEffect("N", 0.05, "play when the tension reverses, full width"),
        "saturation": LabEffect("-", 0.1, "tension ends at (1 - size) of 1.6 N"),
        "quantization": LabEffect("N", 0.1, "tension in steps"),
        "sensor_scale": LabEffect("-", 0.06, "all places times 1 + size"),
        "tip_scale": LabEffect("-", 0.06, "tip places times 1 + size: a lens or a slipped marker"),
        "stop": LabEffect("N/m", 2.0, "a one-sided spring beyond 3 mm at the tip", outside=True),
        "knock": LabEffect("N", 0.005, "a push on the tip, 60 ms, 1.2 s in", outside=True),
    }

    def __init__(self, shape: BeamShape | None = None) -> None:
        self.shape = BeamShape() if shape is None else shape

    def plans(self, rng: np.random.Generator) -> list[Plan]:
        from scipy.signal import chirp

        t = np.arange(round(RATE_HZ * DURATION_S)) / RATE_HZ
        commands = {
            "release": 1.6 * (_rise(t, 0.0, 0.3) - _rise(t, 0.5, 0.1)),
            "chirp": _rise(t, 0.0, 0.2) * (0.8 + 0.6 * chirp(t, 0.8, DURATION_S, 6.0, phi=-90)),
            "steps": _steps(t, np.array([0.4, 1.4, 0.2, 0.8, 1.5, 0.1])),
        }
        unseen = _rise(t, 0.0, 0.2) * (
            0.9 + 0.4 * np.sin(2 * np.pi * 1.7 * t) + 0.2 * np.sin(2 * np.pi * 4.1 * t + 1.0)
        )
        plans = [
            Plan(f"{name}_{repeat}", name, "fit", t, {"tendon_N": command})
            for repeat in "ab"
            for name, command in commands.items()
        ][:-1]
        return [*plans, Plan("two_tones", "two_tones", "test", t, {"tendon_N": unseen})]

    def nuisances(self, rng: np.random.Generator) -> dict[str, Any]:
        return {
            "marker_place_m": rng.normal(0.0, 0.5e-3, len(MARKERS_M)),
            "zero_seed": int(rng.integers(2**31)),
        }

    def measure(self, plan: Plan, truth: dict[str, Any]) -> tuple[Array, dict[str, Array]]:
        """Displacements [m] from the free shape; one zero error per run and marker."""
        stiffness = truth["base"]["youngs_modulus"]
        stiffness *= 1.0 + size_of(truth, "temperature_drift") * truth["order"]
        modes = beam_modes(self.shape, stiffness, WATER_KG_M3 * size_of(truth, "added_mass"))
        tension = _actuator(plan, truth)
        q = _Motion(modes, self.shape, stiffness, truth).run(tension)
        places = np.array(list(MARKERS_M.values())) + truth["nuisances"]["marker_place_m"]
        out = q @ np.array([modes.at(p) for p in places]).T
        out *= 1.0 + size_of(truth, "sensor_scale")
        out[:, 0] *= 1.0 + size_of(truth, "tip_scale")
        zero = np.random.default_rng([truth["nuisances"]["zero_seed"], truth["order"]])
        return out + zero.normal(0.0, 0.1e-3, out.shape[1]), dict(plan.command)

    def facts(self) -> dict[str, Any]:
        return {
            "geometry": asdict(self.shape),
            "tendon": {
                "max_tension_N": MAX_TENSION_N,
                "offset_m": TENDON_OFFSET_M,
                "meaning": "moment at the tip: tension times offset; bends towards +y",
            },
            "markers": {
                "place_m": MARKERS_M,
                "place_sd_m": 0.5e-3,
                "zero_sd_m": 0.1e-3,
                "meaning": "displacement in y of the axis at x from the clamp",
            },
            "command": "logged at the samples, linear between them; the bar starts at rest",
            "gravity_m_s2": 0.0,
        }


class _Motion:
    """Modal motion: q'' + d q' + w^2 q = B M(t) + nonlinear forces."""

    def __init__(self, modes: BeamModes, shape: BeamShape, stiffness: float, truth: dict[str, Any]):
        self.modes, self.truth = modes, truth
        self.substeps = _substeps(truth)
        self.step = 1.0 / RATE_HZ / self.substeps
        beta = truth["base"]["rayleigh_beta"] + size_of(truth, "stiffness_damping")
        damping = beta * modes.omega**2
        self.propagators = [
            _phi_functions(_mode_rates(w, d, size_of(truth, "loss_factor")), self.step)
            for w, d in zip(modes.omega, damping, strict=True)
        ]
        self.moment_shape = modes.rotation[-1]
        self.tip = modes.deflection[-1]
        depth4 = shape.width * shape.depth**5 / 80.0  # integral of y^4 over the section
        self.stiffening = size_of(truth, "stiffening") * stiffness * depth4 * modes.cell
        self.linear = size_of(truth, "volume_drag")
        self.quadratic = size_of(truth, "quadratic_volume_drag")
        self.current = size_of(truth, "current")
        self.friction = size_of(truth, "dry_friction")
        self.tilt = shape.density * size_of(truth, "tilt")  # per volume

    def run(self, tension: Array) -> Array:
        """Modal coordinates at the samples, from the tension at all substeps."""
        decay = np.array([p[0] for p in self.propagators])
        held = np.array([p[1] for p in self.propagators])
        ramp = np.array([p[2] for p in self.propagators])
        state = np.zeros((len(self.modes.omega), decay.shape[-1]))
        weight = self.modes.deflection.T @ (self.tilt * self.modes.node_volume)
        at_first = self.moment_shape * (TENDON_OFFSET_M * tension[0]) + weight
        state[:, 0] = at_first / self.modes.omega**2
        state[:, 2:] = state[:, :1]  # branches have relaxed
        out = []
        force = self._force(state, tension[0], 0.0)
        for i in range(len(tension)):
            if i % self.substeps == 0:
                out.append(state[:, 0].copy())
            following = tension[min(i + 1, len(tension) - 1)]
            guess = np.einsum("ijk,ik->ij", decay, state) + held * force[:, None]
            later = self._force(guess, following, (i + 1) * self.step)
            state = self._rub(guess + ramp * (later - force)[:, None], held)
            force = self._force(state, following, (i + 1) * self.step)
        return np.array(out)

    def _force(self, state: Array, tension: float, t: float) -> Array:
        """Modal forces."""
        modes, q, v = self.modes, state[:, 0], state[:, 1]
        force = self.moment_shape * (TENDON_OFFSET_M * tension)
        body = np.zeros(len(modes.x))
        if self.linear or self.quadratic:
            speed = modes.deflection @ v
            body -= self.linear * speed + self.quadratic * np.abs(speed) * speed
        if self.current:
            speed = modes.deflection @ v - self.current
            body -= 2e4 * np.abs(speed) * speed
        body += self.tilt
        force = force + modes.deflection.T @ (body * modes.node_volume)
        if self.stiffening:
            force = force - modes.curvature.T @ (self.stiffening * (modes.curvature @ q) ** 3)
        push = self._push(float(self.tip @ q), t)
        return force + self.tip * push if push else force

    def _push(self, tip_m: float, t: float) -> float:
        push = -size_of(self.truth, "stop") * max(tip_m - STOP_M, 0.0)
        inside = 1.2 <= t < 1.26
        return push + (size_of(self.truth, "knock") * np.sin(np.pi * (t - 1.2) / 0.06) * inside)

    def _rub(self, state: Array, held: Array) -> Array:
        """Coulomb friction at the tip, held over the substep that ends in ``state``.

        It is the force that would bring the tip to rest, up to ``friction``: a tip that sticks
        stays where it is.
        """
        if self.friction == 0.0:
            return state
        response = held * self.tip[:, None]  # modal state per newton
        needed = -float(self.tip @ state[:, 1]) / float(self.tip @ response[:, 1])
        return state + response * np.clip(needed, -self.friction, self.friction)


def _mode_rates(omega: float, damping: float, loss: float) -> Array:
    """A of z' = A z + e_1 force for z = (q, q', m_1, ...).

    A loss factor ``loss`` that does not depend on the frequency: Maxwell branches
    k g (q - m_i), tau_i m_i' = q - m_i with g = (2 / pi) loss ln(spacing), as the integral of
    w tau / (1 + (w tau)^2) over ln(tau) is pi / 2.
    """
    tau = LOSS_TAU_S if loss else np.zeros(0)
    k, g = omega**2, 2.0 / np.pi * loss * np.log(tau[0] / tau[1]) if loss else 0.0
    a = np.zeros((2 + len(tau), 2 + len(tau)))
    a[0, 1] = 1.0
    a[1, :2] = [-k * (1.0 + g * len(tau)), -damping]
    a[1, 2:] = k * g
    for i, t in enumerate(tau, start=2):
        a[i, 0], a[i, i] = 1.0 / t, -1.0 / t
    return a


def _phi_functions(rates: Array, h: float) -> tuple[Array, Array, Array]:
    """exp(A h), and the responses at h to a unit force held and to one that ramps from 0 to 1."""
    n = len(rates)
    a = np.zeros((n + 2, n + 2))
    a[:n, :n] = rates
    a[1, n] = 1.0
    a[n, n + 1] = 1.0 / h
    e = linalg.expm(a * h)
    return e[:n, :n], e[:n, n], e[:n, n + 1]


def _rise(t: Array, start: float, length: float) -> Array:
    """From 0 to 1 without a kink: nothing is struck, and high modes do not ring."""
    share = np.clip((t - start) / length, 0.0, 1.0)
    return 0.5 * (1.0 - np.cos(np.pi * share))


def _steps(t: Array, levels: Array) -> Array:
    """Levels of equal length, joined by rises of 0.1 s."""
    each = (t[-1] + 1.0 / RATE_HZ) / len(levels)
    jumps = np.diff(levels, prepend=0.0)
    return sum((jump * _rise(t, i * each, 0.1) for i, jump in enumerate(jumps)), np.zeros(len(t)))


def _substeps(truth: dict[str, Any]) -> int:
    """Per sample; friction is of first order where the tip turns back, and needs finer ones."""
    return SUBSTEPS * (3 if size_of(truth, "dry_friction") else 1)


def _actuator(plan: Plan, truth: dict[str, Any]) -> Array:
    """Tension in the tendon at all substeps [N]."""
    substeps = _substeps(truth)
    t = np.arange(len(plan.time_s) * substeps) / RATE_HZ / substeps
    u = np.interp(t, plan.time_s, plan.command["tendon_N"])
    if (grain := size_of(truth, "quantization")) > 0.0:
        u = grain * np.round(u / grain)
    u = np.sign(u) * np.maximum(np.abs(u) - size_of(truth, "tension_dead_band"), 0.0)
    if (play := size_of(truth, "tension_backlash")) > 0.0:
        u = _backlash(u, 0.5 * play)
    u = np.minimum(u, MAX_TENSION_N * (1.0 - size_of(truth, "saturation")))
    step = 1.0 / RATE_HZ / substeps
    return truth["gain"] * delayed(t, u, size_of(truth, "delay"), size_of(truth, "lag"), step)


def _backlash(u: Array, half: float) -> Array:
    """Play of +-half: the output follows only while the input pushes against one side."""
    out = np.empty_like(u)
    y = u[0]
    for i, value in enumerate(u):
        y = min(max(y, value - half), value + half)
        out[i] = y
    return out
