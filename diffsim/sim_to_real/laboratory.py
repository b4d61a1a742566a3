"""A virtual laboratory: servo, tank and camera about a robot of rods, as hardware of the loop."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from diffsim.data.importers.starfish import COMMAND
from diffsim.data.study import Run
from diffsim.sim_to_real.command import RATE_HZ, Command, Limits
from diffsim.sim_to_real.rod_swimmer import DT, STEPS_PER_SAMPLE, RodSwimmer, Truth

Array = NDArray[np.float64]
LEGS_AND_PLACES = ((1, 0.070), (1, 0.040), (0, 0.0362), (0, 0.0632))  # of m1 to m4 [m]
SETTLE_S = 1.0  # the servo goes to the first value and waits


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Servo and camera.

    Attributes:
        step_m: The servo goes to whole multiples of this pull [m].
        lag_s: First-order lag of the servo [s].
        rate_m_s: Greatest speed [m/s].
        backlash_m: Play between servo and cable [m].
        noise_m: Noise of a tracked marker, sd [m].
        pixel_m: Places come in multiples of this [m].
        tilt_rad: Angle of the camera about its axis [rad].
        scale: Scale of the picture [-].
        lost: Share of places that the tracker loses.
    """

    step_m: float = 1.6e-4
    lag_s: float = 0.035
    rate_m_s: float = 0.25
    backlash_m: float = 3e-4
    noise_m: float = 8e-5
    pixel_m: float = 2e-5
    tilt_rad: float = 0.01
    scale: float = 1.005
    lost: float = 0.002


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
        """See :class:`~diffsim.sim_to_real.Hardware`.

        Raises:
            ValueError: the command is beyond the limits.
        """
        command.check(self.limits)
        rng = np.random.default_rng([self.seed, order])
        draw = self.scatter * rng.standard_normal(5)
        truth = replace(
            self.truth,
            rail_friction=self.truth.rail_friction * np.exp(0.16 * draw[0]),
            current=self.truth.current + 3e-4 * draw[1],
            youngs_modulus=self.truth.youngs_modulus * np.exp(0.01 * draw[2]),
            slack_m=max(0.0, self.truth.slack_m + 1e-4 * draw[3]),
        )
        robot = RodSwimmer(truth)
        wish = command.during(self.duration_s)
        quantized = np.round(wish / self.rig.step_m) * self.rig.step_m
        wait = np.full(round(SETTLE_S * RATE_HZ), quantized[0])
        ramp = np.clip(np.arange(len(wait)) / (0.25 * len(wait)), 0.0, 1.0)
        servo = self._servo(np.repeat(np.concatenate([ramp * wait, quantized]), STEPS_PER_SAMPLE))
        places = robot.run(servo)[len(wait) :]
        offset = 0.01 * draw[4]
        time = np.arange(len(wish)) / RATE_HZ
        seen = self._camera(robot, places, rng)
        seen = np.stack([np.interp(time + offset, time, channel) for channel in seen.T], 1)
        seen += self.rig.noise_m * rng.standard_normal(seen.shape)
        seen = np.round(seen / self.rig.pixel_m) * self.rig.pixel_m
        gone = np.repeat(rng.random((len(seen), 4)) < self.rig.lost, 2, axis=1)
        return Run(
            name=f"run_{order}",
            time_s=time,
            measured=np.where(gone, np.nan, seen),
            command={COMMAND: quantized},
            group=f"run_{order}",
            order=order,
        )

    def _servo(self, wish: Array) -> Array:
        """Pull of the cable at every step: lag, rate, backlash."""
        rig, out = self.rig, np.empty_like(wish)
        arm, cable = 0.0, 0.0
        share, most = 1.0 - np.exp(-DT / rig.lag_s), rig.rate_m_s * DT
        for k, target in enumerate(wish.tolist()):
            arm += min(max(share * (target - arm), -most), most)
            cable = min(max(cable, arm - 0.5 * rig.backlash_m), arm + 0.5 * rig.backlash_m)
            out[k] = cable
        return out

    def _camera(self, robot: RodSwimmer, places: Array, rng: np.random.Generator) -> Array:
        """(num_samples, 8) x and z of the markers in the tilted, scaled picture [m]."""
        c, s = np.cos(self.rig.tilt_rad), np.sin(self.rig.tilt_rad)
        origin = np.array([0.35, -0.11]) + 0.01 * rng.standard_normal(2)
        channels = []
        for leg, r in LEGS_AND_PLACES:
            x, out = robot.flat_side(places, leg, r).T
            z = -out if leg == 1 else out
            channels += [origin[0] + c * x - s * z, origin[1] + s * x + c * z]
        return self.rig.scale * np.stack(channels, 1)
