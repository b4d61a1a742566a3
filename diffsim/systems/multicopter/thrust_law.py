"""From recorded commands to thrusts, and from named quantities to a vehicle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffsim.copter import Multicopter
from diffsim.copter.vehicle.multicopter import Fleet
from diffsim.copter.vehicle.rotor import RotorModel
from diffsim.data.study import Run
from diffsim.systems.commands import command_of, interpolated
from diffsim.systems.multicopter.frames import RecordingFrames
from diffsim.systems.multicopter.keys import CommandKeys, RotorKeys, ThrustKeys
from diffsim.systems.multicopter.motion import stack_points

Values = Mapping[str, Tensor]


@dataclass(frozen=True, kw_only=True, eq=False)
class ThrustLaw:
    """Thrusts that a run's commands ask for."""

    commands: CommandKeys  # which columns, and what they mean
    # law of thrusts; None: commands are thrusts, or ``rotor`` has the law
    thrust: ThrustKeys | None
    rotor: RotorModel | None  # model of motor and propeller; None: none given
    battery: str | None  # name of the command that is the battery's voltage; None: none

    def thrusts(self, run: Run, values: Values) -> Tensor:
        """(points, num_samples, n_rotors) [N], before lag, gains and shares.

        Args:
            values: ``thrust_coefficient``, () or (points,), where the law has one.
        """
        u = self._compute_input(run)
        if self.thrust is None:
            if self.commands.meaning == "thrust":
                return u.clamp(min=0.0)
            assert self.rotor is not None
            return self.rotor.thrust(u).clamp(min=0.0)
        if self.thrust.curve:
            rows = np.asarray(self.thrust.curve, dtype=np.float64)
            return interpolated(u, rows[:, 0], rows[:, 1]).clamp(min=0.0)
        power = u.clamp(min=0.0) ** self.exponent
        coefficient = values["thrust_coefficient"].reshape(-1, 1, 1)
        turning = torch.where(power > 0.0, self.thrust.offset, 0.0)
        return (coefficient * power + turning).clamp(min=0.0)

    def commands_for(self, thrusts: Tensor) -> Tensor:
        """Commands that ask for thrusts [N], of the same shape, at the nominal voltage."""
        keys = self.commands
        if self.thrust is None:
            if keys.meaning == "thrust":
                return thrusts
            assert self.rotor is not None
            return (
                self.rotor.signal(thrusts) if keys.meaning == "pulse" else self.rotor.speed(thrusts)
            )
        if self.thrust.curve:
            rows = np.asarray(self.thrust.curve, dtype=np.float64)
            u = torch.from_numpy(np.interp(thrusts.numpy(), rows[:, 1], rows[:, 0]))
        else:
            assert self.thrust.coefficient is not None
            lift = (thrusts - self.thrust.offset).clamp(min=0.0) / self.thrust.coefficient.value
            u = lift ** (1.0 / self.exponent)
        return keys.low + u * (keys.high - keys.low) if keys.meaning == "throttle" else u

    @property
    def exponent(self) -> float:
        """Power of the command in the thrust."""
        if self.thrust is None or self.thrust.exponent is None:
            return 1.0 if self.commands.meaning == "thrust" else 2.0
        return self.thrust.exponent

    @property
    def is_squared(self) -> bool:
        """Whether the command is a speed in rad/s, and the thrust in proportion to its square."""
        has_coefficient = self.thrust is not None and self.thrust.coefficient is not None
        return self.commands.meaning == "speed" and has_coefficient and self.exponent == 2.0

    def _compute_input(self, run: Run) -> Tensor:
        """The law's u, (1, num_samples, n_rotors)."""
        keys = self.commands
        u = torch.stack([command_of(run, name) for name in keys.columns], -1)[None]
        voltage = None
        if self.battery is not None:
            voltage = command_of(run, self.battery)[None, :, None]
        if keys.meaning == "throttle":
            u = (u - keys.low) / (keys.high - keys.low)
            if keys.per_voltage is not None and voltage is not None:
                u = u * voltage / keys.per_voltage
        if keys.meaning == "pulse":
            assert self.rotor is not None
            u = self.rotor.speed_at(u, voltage)
        return u


def described_fleet(
    values: Values, rotors: tuple[RotorKeys, ...], frames: RecordingFrames, radius: float
) -> Fleet:
    """The vehicle of named quantities, in the model's frames, (points or 1, ...).

    Args:
        values: ``mass``, ``inertia_xx`` ... ``inertia_yz``, ``center_of_mass_x`` ...,
            ``rotor_1_x`` ... and ``torque_ratio``, () or (points,) each.
        rotors: Senses and axes, in order.
        frames: Frames that places and axes are written in.
        radius: Of the propellers [m].
    """

    def vector(stem: str) -> Tensor:
        return stack_points([values[f"{stem}_{axis}"] for axis in "xyz"])

    up = [0.0, 0.0, 1.0 if frames.body == "FLU" else -1.0]
    axes = torch.tensor([r.axis or up for r in rotors], dtype=torch.float64)
    axes = axes / axes.norm(dim=-1, keepdim=True)
    entries = [
        values[f"inertia_{e}"] for e in ("xx", "xy", "xz", "xy", "yy", "yz", "xz", "yz", "zz")
    ]
    inertia = stack_points(entries).reshape(-1, 3, 3)
    places = [vector(f"rotor_{i + 1}") for i in range(len(rotors))]
    places = [place - vector("center_of_mass") for place in places]
    positions = torch.stack(torch.broadcast_tensors(*places), 1)
    spins = torch.tensor([1.0 if r.spin == "cw" else -1.0 for r in rotors], dtype=torch.float64)
    n = len(rotors)
    return Fleet(
        mass=values["mass"].reshape(-1),
        inertia=frames.inertia(inertia),
        positions=frames.in_body(positions),
        directions=frames.in_body(axes)[None],
        spins=spins[None],
        torque_ratios=values["torque_ratio"].reshape(-1, 1).expand(-1, n),
        max_thrusts=torch.ones(1, n, dtype=torch.float64),
        radii=torch.full((1, n), radius, dtype=torch.float64),
    )


def designed_fleet(values: Values, design: Multicopter, frames: RecordingFrames) -> Fleet:
    """The vehicle of a design file, its mass and center of mass moved by named quantities."""
    shift = stack_points([values[f"center_of_mass_{axis}"] for axis in "xyz"])
    fleet = Fleet.of([design])
    return fleet.replace(
        mass=values["mass"].reshape(-1),
        positions=fleet.positions - frames.in_body(shift)[:, None],
    )
