"""A virtual laboratory: servo, tank and camera about a robot of rods, as hardware of the loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Run
from labs.loop.command import RATE_HZ, Command, Limits
from labs.loop.recordings import COMMAND
from labs.loop.rod_swimmer import DT, STEPS_PER_SAMPLE, RodSwimmer, Truth

Array = NDArray[np.float64]
Policy = Callable[[float, Array], float]
"""Time [s] and markers' places (8,) [m] -> contraction [m]."""
LEGS_AND_PLACES = ((1, 0.070), (1, 0.040), (0, 0.0362), (0, 0.0632))  # of m1 to m4 [m]
SETTLE_S = 1.0  # the servo goes to the first value and waits


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Servo and camera."""

    step_m: float = 1.6e-4  # the servo goes to whole multiples of this pull [m]
    lag_s: float = 0.035  # first-order lag of the servo [s]
    rate_m_s: float = 0.25  # greatest speed [m/s]
    backlash_m: float = 3e-4  # play between servo and cable [m]
    noise_m: float = 8e-5  # noise of a tracked marker, sd [m]
    pixel_m: float = 2e-5  # places come in multiples of this [m]
    tilt_rad: float = 0.01  # angle of the camera about its axis [rad]
    scale: float = 1.005  # scale of the picture [-]
    lost: float = 0.002  # share of places that the tracker loses


@dataclass(frozen=True, kw_only=True)
class VirtualLaboratory:
    """Hardware that executes commands in a simulation of its own (:mod:`.rod_swimmer`).

    Repeats of one command scatter: rail friction by a sixth, current by 0.3 mm/s, the clocks'
    offset by 10 ms, stiffness by 1 %, slack by 0.1 mm; equal ``seed`` and ``order`` give equal
    recordings.

    Attributes:
        seed: Seed of scatter and noise.
        duration_s: Length of every recording [s]; ten periods in thesis 5.4.4.
        limits: Commands beyond are refused.
        truth, rig: What it is made of.
        scatter: Factor on the scatter of repeats.
    """

    seed: int = 0
    duration_s: float = 30.0
    limits: Limits = field(default_factory=Limits)
    truth: Truth = field(default_factory=Truth)
    rig: Rig = field(default_factory=Rig)
    scatter: float = 1.0
    name = "virtual laboratory"
    virtual = True

    def execute(self, command: Command, *, order: int) -> Run:
        """See :class:`~labs.loop.Hardware`.

        Raises:
            ValueError: the command is beyond the limits.
        """
        command.check(self.limits)
        rng, robot, offset = self._trial(order)
        wish = command.during(self.duration_s)
        quantized = self._whole_steps(wish)
        wait = np.full(round(SETTLE_S * RATE_HZ), quantized[0])
        ramp = np.clip(np.arange(len(wait)) / (0.25 * len(wait)), 0.0, 1.0)
        pull = _Servo(self.rig).follow(
            np.repeat(np.concatenate([ramp * wait, quantized]), STEPS_PER_SAMPLE)
        )
        places = robot.run(pull)[len(wait) :]
        time = np.arange(len(wish)) / RATE_HZ
        seen = self._camera(robot, places, _origin(rng))
        seen = np.stack([np.interp(time + offset, time, channel) for channel in seen.T], 1)
        seen, gone = self._track_markers(seen, rng)
        return _build_run(order, time, np.where(gone, np.nan, seen), quantized)

    def steer(self, policy: Policy, *, order: int) -> Run:
        """Execute what a controller asks for, sample by sample, from rest, and record.

        It sees the markers as the camera tracks them, and its command goes to the servo at once:
        one computer does both, so that there is no offset between their clocks. A marker that is
        lost is seen where it was.

        Args:
            policy: Called with the time since the start [s] and the markers' places (8,) [m], as
                ``CHANNELS``; returns the contraction [m], within ``limits``.
            order: Place in the sequence of experiments, from 0.

        Returns:
            The recording, as of :meth:`execute`.

        Raises:
            ValueError: a command is beyond the limits.
        """
        rng, robot, _ = self._trial(order)
        origin, now, servo = _origin(rng), robot.rest_state(), _Servo(self.rig)
        time = np.arange(round(self.duration_s * RATE_HZ)) / RATE_HZ
        places, asked, last = [], [], None
        for t in time:
            seen = self._camera(robot, now.at[None], origin)[0]
            seen, gone = self._track_markers(seen[None], rng)
            places.append(np.where(gone, np.nan, seen)[0])
            last = seen[0] if last is None else np.where(gone[0], last, seen[0])
            wish = float(policy(float(t), last))
            if not -1e-9 <= wish <= self.limits.contraction_m + 1e-9:
                raise ValueError(
                    f"the controller must ask for 0 to {self.limits.contraction_m:g} m, got "
                    f"{wish:g} m at {t:.3f} s; clamp what it asks for"
                )
            asked.append(wish)
            robot.follow(now, servo.follow(np.full(STEPS_PER_SAMPLE, self._whole_steps(wish))))
        return _build_run(order, time, np.array(places), self._whole_steps(np.array(asked)))

    def _trial(self, order: int) -> tuple[np.random.Generator, RodSwimmer, float]:
        """What scatters between repeats: the robot, the clocks' offset [s]; the noise's source."""
        rng = np.random.default_rng([self.seed, order])
        draw = self.scatter * rng.standard_normal(5)
        truth = replace(
            self.truth,
            rail_friction=self.truth.rail_friction * np.exp(0.16 * draw[0]),
            current=self.truth.current + 3e-4 * draw[1],
            youngs_modulus=self.truth.youngs_modulus * np.exp(0.01 * draw[2]),
            slack_m=max(0.0, self.truth.slack_m + 1e-4 * draw[3]),
        )
        return rng, RodSwimmer(truth), 0.01 * draw[4]

    def _whole_steps(self, wish: Array | float) -> Array:
        return np.asarray(np.round(np.asarray(wish) / self.rig.step_m) * self.rig.step_m)

    def _track_markers(self, seen: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Places (num_samples, 8) with noise and pixels, and which of them are lost."""
        seen = seen + self.rig.noise_m * rng.standard_normal(seen.shape)
        seen = np.round(seen / self.rig.pixel_m) * self.rig.pixel_m
        return seen, np.repeat(rng.random((len(seen), 4)) < self.rig.lost, 2, axis=1)

    def _camera(self, robot: RodSwimmer, places: Array, origin: Array) -> Array:
        """(num_samples, 8) x and z of the markers in the tilted, scaled picture [m]."""
        c, s = np.cos(self.rig.tilt_rad), np.sin(self.rig.tilt_rad)
        channels = []
        for leg, r in LEGS_AND_PLACES:
            x, out = robot.flat_side(places, leg, r).T
            z = -out if leg == 1 else out
            channels += [origin[0] + c * x - s * z, origin[1] + s * x + c * z]
        return self.rig.scale * np.stack(channels, 1)


class _Servo:
    """Lag, rate and backlash between what is asked for and the pull of the cable."""

    def __init__(self, rig: Rig):
        self.rig, self.arm, self.cable = rig, 0.0, 0.0

    def follow(self, wish: Array) -> Array:
        """Pull of the cable at the next steps of ``DT`` [m], as many as wishes [m]."""
        rig, out = self.rig, np.empty_like(wish)
        share, most = 1.0 - np.exp(-DT / rig.lag_s), rig.rate_m_s * DT
        for k, target in enumerate(wish.tolist()):
            self.arm += min(max(share * (target - self.arm), -most), most)
            low, high = self.arm - 0.5 * rig.backlash_m, self.arm + 0.5 * rig.backlash_m
            self.cable = min(max(self.cable, low), high)
            out[k] = self.cable
        return out


def _origin(rng: np.random.Generator) -> Array:
    """Where the picture shows the robot at its start, x and z [m]."""
    return np.array([0.35, -0.11]) + 0.01 * rng.standard_normal(2)


def _build_run(order: int, time: Array, measured: Array, command: Array) -> Run:
    return Run(
        name=f"run_{order}",
        time_s=time,
        measured=measured,
        command={COMMAND: command},
        group=f"run_{order}",
        order=order,
    )
