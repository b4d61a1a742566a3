"""A copter as a diagnosis found it: sizes of an ``extended_model.yaml`` put into a vehicle.

>>> copter = ExtendedCopter.read("runs/quad", vehicle)
>>> copter.fly(vehicle, start, thrusts, dt=0.01)  # in place of ``diffsim.copter.fly``
>>> copter.drawn(16, rng).fly(vehicle, start, thrusts, dt=0.01)  # 16, as the data allow
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.copter import Feedback, Fleet, Flight, FlightEffects, FlightState, Multicopter, fly
from diffsim.copter.vehicle.effects import BodyDrag, MotorLag, RotorDrag
from diffsim.core.checked import checked
from diffsim.identify.model_file import SavedModel, read_extended
from diffsim.identify.ranges import SURE_SD, range_of_number
from diffsim.systems.multicopter.frames import FRAMES, RecordingFrames

SYSTEM = "multicopter"  # name of the plain model in the file
_POSITIVE = (
    "mass",
    "mass_gain",
    "thrust_gain",
    "torque_gain",
    "inertia_gain",
    "torque_ratio",
    "motor_lag",
    "motor_time_constant",
    "inertia_xx",
    "inertia_yy",
    "inertia_zz",
)
_CENTER = tuple(f"center_of_mass_{a}" for a in "xyz")  # where the vehicle was described
_MOVED = ("center_of_mass.x", "center_of_mass.y")  # by a cause
_DRAGS = ("body_drag", "parasitic_drag", "rotor_drag")
_NEVER_NEGATIVE = (*_DRAGS, "extra_mass", "lag", "delay")
_OF_ROTOR = re.compile(r"(weak_rotor|thrust_loss|torque_loss)_(\d+)|rotor_(\d+)_share")
# What instruments of the recording showed; a copter of an environment has others.
_OF_RECORDING = re.compile(
    r"(attitude|body_rates|accelerometer|specific_force)_offset_[xyz]|clock(_.*)?|.*@.*"
)
_LAGS = ("motor_lag", "motor_time_constant", "lag")


@dataclass(frozen=True, eq=False)
class CopterSizes:
    """Sizes that change a copter, with their posterior."""

    saved: SavedModel  # content of the file that they are of
    names: tuple[str, ...]  # parameters and components of causes, each in the unit of the file
    values: Tensor  # of each, (num_sizes,)
    set_aside: tuple[str, ...]  # names of what only the recording's instruments or single runs had
    frames: RecordingFrames  # that the recording is written in

    @classmethod
    def read(cls, path: str | Path, num_rotors: int) -> CopterSizes:
        """Read an ``extended_model.yaml``.

        Args:
            path: The file, or the folder that holds it.
            num_rotors: Of the vehicle that the study describes.

        Raises:
            FileNotFoundError: no such file.
            ValueError: a file of another system, or parts that an environment cannot simulate.
        """
        saved = read_extended(path)
        if saved.model != SYSTEM:
            raise ValueError(
                f"{saved.path}: a model of {saved.model or 'an unnamed system'}, not of a "
                "multicopter; a copter needs one that was fitted to flights"
            )
        names, aside, refused = [], [], []
        for name in saved.values:
            if _OF_RECORDING.fullmatch(name):
                aside.append(name)
            elif _is_known(name, num_rotors):
                names.append(name)
            else:
                refused.append(name)
        if refused:
            raise ValueError(
                f"{saved.path}: {', '.join(refused)} cannot be simulated in a copter's "
                "environment or by `fly`; diagnose without it (diffsim diagnose explain STUDY "
                "--without CAUSE, or state the number in the study)"
            )
        return cls(
            saved=saved,
            names=tuple(names),
            values=torch.tensor([saved.values[n] for n in names], dtype=torch.float64),
            set_aside=tuple(aside),
            frames=_frames_of(saved, names),
        )

    def draw(self, batch: int, rng: np.random.Generator) -> Tensor:
        """Sizes drawn from the posterior, (batch, num_sizes).

        As ``SavedModel.draw`` has them; no drag, load or delay is negative.
        """
        drawn = self.saved.draw(self.names, batch, rng)
        low = [0.0 if name in _NEVER_NEGATIVE else -torch.inf for name in self.names]
        return torch.maximum(drawn, torch.tensor(low, dtype=torch.float64))

    @property
    def most_delay(self) -> float:
        """Longest delay of a draw [s]."""
        if "delay" not in self.names:
            return 0.0
        return float(
            range_of_number(self.saved, "delay").drawn(torch.tensor(SURE_SD, dtype=torch.float64))
        )

    def has_any(self, names: tuple[str, ...]) -> bool:
        """Whether the file holds one of some sizes."""
        return any(name in self.names for name in names)

    @property
    def has_lag(self) -> bool:
        """Whether the file says how the thrusts lag."""
        return self.has_any(_LAGS)

    @property
    def has_drag(self) -> bool:
        """Whether the file says how the air brakes."""
        return self.has_any(_DRAGS)

    def thrust_gains(self, sizes: Tensor, num_rotors: int) -> Tensor:
        """Thrust over the thrust asked for, (batch, num_rotors).

        Args:
            sizes: (batch, num_sizes).
        """
        v = self._by_name(sizes)
        gains = (
            sizes.new_ones(len(sizes), num_rotors)
            * v.get("thrust_gain", sizes.new_ones(1))[:, None]
        )
        return gains * self._kept_share(v, sizes, num_rotors, "weak_rotor", "thrust_loss")

    def delay(self, sizes: Tensor) -> Tensor:
        """Of the thrusts behind their commands, (batch,) [s]."""
        return self._by_name(sizes).get("delay", sizes.new_zeros(len(sizes)))

    def vehicles(
        self,
        vehicle: Multicopter,
        effects: FlightEffects,
        sizes: Tensor,
        described: Multicopter | None = None,
    ) -> tuple[Fleet, FlightEffects]:
        """The vehicles, one per row of sizes, and what they feel in flight.

        Args:
            vehicle: As the study describes it, or another of its kind.
            effects: What it feels beside what the file says.
            sizes: (batch, num_sizes).
            described: As the study describes it, where ``vehicle`` is another: mass and inertia
                are then off by the share by which they were off there.
        """
        v, n = self._by_name(sizes), vehicle.num_rotors
        fleet = Fleet.of([vehicle])
        if described is not None:
            v = _of_another(v, vehicle, described)
        one = sizes.new_ones(len(sizes))
        mass = v.get("mass", fleet.mass * one) * v.get("mass_gain", one) + v.get("extra_mass", 0.0)
        fleet = fleet.replace(
            mass=mass,
            inertia=_inertias(fleet.inertia, v) * v.get("inertia_gain", one)[:, None, None],
            positions=fleet.positions - self._center(v, sizes)[:, None],
            torque_ratios=self._torque_ratios(fleet.torque_ratios, v, sizes),
        )
        return fleet, _with_file_effects(effects, v, n)

    def _by_name(self, sizes: Tensor) -> dict[str, Tensor]:
        return dict(zip(self.names, sizes.unbind(1), strict=True))

    def _kept_share(
        self, v: Mapping[str, Tensor], sizes: Tensor, count: int, *causes: str
    ) -> Tensor:
        """Share that is left of each rotor's thrust or torque, (batch, num_rotors)."""
        columns = []
        for i in range(1, count + 1):
            share = sizes.new_ones(len(sizes))
            for cause in causes:
                share = share * (1.0 - v.get(f"{cause}_{i}", 0.0 * share))
            if "weak_rotor" in causes:
                share = share * v.get(f"rotor_{i}_share", torch.ones_like(share))
            columns.append(share)
        return torch.stack(columns, 1)

    def _torque_ratios(self, nominal: Tensor, v: Mapping[str, Tensor], sizes: Tensor) -> Tensor:
        """Reaction torque per thrust, (batch, num_rotors) [m]."""
        count, one = nominal.shape[1], sizes.new_ones(len(sizes))
        ratio = v["torque_ratio"][:, None] if "torque_ratio" in v else nominal
        ratio = ratio * v.get("torque_gain", one)[:, None]
        # a rotor that lost thrust alone takes the same torque for it
        kept_torque = self._kept_share(v, sizes, count, "torque_loss")
        return ratio * kept_torque / self._kept_share(v, sizes, count, "thrust_loss")

    def _center(self, v: Mapping[str, Tensor], sizes: Tensor) -> Tensor:
        """Shift of the center of mass, forward, right, down, (batch, 3) [m]."""
        zero = sizes.new_zeros(len(sizes))
        parts = [
            v.get(f"center_of_mass_{a}", zero) + v.get(f"center_of_mass.{a}", zero) for a in "xyz"
        ]
        return self.frames.in_body(torch.stack(parts, 1))


@checked(kinds_only=True)
@dataclass(frozen=True, eq=False)
class ExtendedCopter:
    """A diagnosed copter for whatever flies vehicles: its ``fly`` stands in for the plain one.

    Attributes:
        sizes: What the file says.
        described: Vehicle as the study describes it.
        at: Sizes of each member of a batch, (batch, num_sizes); may carry gradients.
    """

    sizes: CopterSizes
    described: Multicopter
    at: Tensor

    @classmethod
    @checked
    def read(cls, path: str | Path, described: Multicopter) -> ExtendedCopter:
        """Read an ``extended_model.yaml``.

        Args:
            path: The file, or the folder that holds it.
            described: Vehicle as the study describes it.

        Raises:
            FileNotFoundError: no such file.
            ValueError: a file of another system, or parts that a flight of ``fly`` does not have.
        """
        sizes = CopterSizes.read(path, described.num_rotors)
        return cls(sizes, described, sizes.values[None])

    @checked
    def drawn(self, count: int, rng: np.random.Generator) -> ExtendedCopter:
        """As many members, each as the posterior allows."""
        return replace(self, at=self.sizes.draw(count, rng))

    @property
    def stepwise(self) -> Callable[..., Flight]:
        """``fly`` for whoever flies one step after the other, as ``FlightSimulator`` does.

        Raises:
            ValueError: a delay of the file, which such a step knows nothing of.
        """
        if bool(self.sizes.delay(self.at).detach().any()):
            raise ValueError(
                f"{self.sizes.saved.path}: thrusts come late there, which a flight step by step "
                "does not know; fly it as an environment, make_task('CopterHover', model=FILE)"
            )
        return self.fly

    @checked
    def fly(
        self,
        vehicle: Multicopter,
        start: FlightState,
        commands: Tensor,
        *,
        dt: float,
        feedback: Feedback | None = None,
        effects: FlightEffects | None = None,
        **options: Any,
    ) -> Flight:
        """As :func:`diffsim.copter.fly`, but as the diagnosis found that vehicles fly.

        Args:
            vehicle: As described, or another design of the same kind, with as many rotors.
            start: Leading axis (batch or 1,).
            commands: Thrusts that are asked for, (batch or 1, steps, n_rotors) [N].
            dt: Control period [s].
            feedback: Makes the commands a feed-forward.
            effects: What is there beside what the file says.
            **options: Further ones of ``fly``.

        Raises:
            ValueError: a delay of the file with a feedback, which ``fly`` cannot delay.

        Gradients: as of ``fly``, and sizes.
        """
        late = self.sizes.delay(self.at)
        if bool(late.detach().any()):
            if feedback is not None:
                raise ValueError(
                    f"{self.sizes.saved.path}: thrusts come late there, and a feedback of `fly` "
                    "cannot; fly it as an environment, make_task('CopterHover', model=FILE)"
                )
            commands = _held_late(commands, late / dt)
        gains = self.sizes.thrust_gains(self.at, vehicle.num_rotors)
        if feedback is not None:
            gain = feedback.gain if feedback.gain.dim() == 3 else feedback.gain[None]
            feedback = replace(feedback, gain=gains[..., None] * gain)
        fleet, felt = self.sizes.vehicles(
            vehicle, effects or FlightEffects(), self.at, self.described
        )
        return fly(
            fleet,
            start,
            gains[:, None] * commands,
            dt=dt,
            feedback=feedback,
            effects=felt,
            **options,
        )


def _held_late(commands: Tensor, steps: Tensor) -> Tensor:
    """Held commands (batch, num_steps, width) that come late, in the mean over each step.

    Args:
        commands: The first has been held before.
        steps: Delay in steps, (batch,).
    """
    count = commands.shape[1]
    late: Tensor | float = 0.0
    for age in range(int(steps.detach().max()) + 2):
        kept = torch.cat([commands[:, :1].expand(-1, min(age, count), -1), commands], 1)[:, :count]
        # late by 2.3 steps: 0.7 of what was asked two steps ago, 0.3 of three
        late = late + (1.0 - (age - steps).abs()).clamp(min=0.0)[:, None, None] * kept
    assert isinstance(late, Tensor)
    return late


def _of_another(
    v: Mapping[str, Tensor], vehicle: Multicopter, described: Multicopter
) -> dict[str, Tensor]:
    """Sizes in which mass and inertia are those of another vehicle, off by the same shares."""
    out = dict(v)
    if "mass" in v:
        out["mass"] = v["mass"] * (vehicle.mass / described.mass)
    for i, axis in enumerate("xyz"):
        if (name := f"inertia_{axis}{axis}") in v:
            out[name] = v[name] * (vehicle.inertia[i, i] / described.inertia[i, i])
    return out


def _is_known(name: str, num_rotors: int) -> bool:
    if found := _OF_ROTOR.fullmatch(name):
        return 1 <= int(found[2] or found[3]) <= num_rotors
    return name in (*_POSITIVE, *_CENTER, *_MOVED, *_NEVER_NEGATIVE)


def _frames_of(saved: SavedModel, names: list[str]) -> RecordingFrames:
    """Frames of the recording; only a center of mass has a direction in them."""
    given = saved.frame.get(FRAMES)
    if given is not None:
        return RecordingFrames(**given)
    if directed := [name for name in names if name in (*_CENTER, *_MOVED)]:
        raise ValueError(
            f"{saved.path}: does not say in which frame {directed[0]} is; write it again with "
            "`diffsim diagnose explain`"
        )
    return RecordingFrames()


def _inertias(nominal: Tensor, v: Mapping[str, Tensor]) -> Tensor:
    """(batch or 1, 3, 3) [kg m^2]; half turns of the body's frame leave the diagonal as it is."""
    out = nominal
    for i, axis in enumerate("xyz"):
        if f"inertia_{axis}{axis}" in v:
            mine = torch.zeros(3, 3, dtype=torch.float64)
            mine[i, i] = 1.0
            out = out * (1.0 - mine) + v[f"inertia_{axis}{axis}"][:, None, None] * mine
    return out


def _with_file_effects(
    effects: FlightEffects, v: Mapping[str, Tensor], count: int
) -> FlightEffects:
    if lag := [v[name] for name in _LAGS if name in v]:
        tau = torch.stack(lag).sum(0).clamp(min=1e-6)[:, None].expand(-1, count)
        effects = replace(effects, motor_lag=MotorLag(time_constants=tau))
    if "rotor_drag" in v:
        effects = replace(effects, rotor_drag=RotorDrag(coefficient=v["rotor_drag"]))
    linear, square = v.get("body_drag"), v.get("parasitic_drag")
    if linear is None and square is None:
        return effects
    size = linear if linear is not None else square
    assert size is not None
    none = torch.zeros_like(size)
    along = none if linear is None else linear
    level = [along, along, none]  # the body's drag acts across its z axis
    by_square = none if square is None else square
    drag = BodyDrag(linear=torch.stack(level, 1), quadratic=torch.stack([by_square] * 3, 1))
    return replace(effects, body_drag=drag)
