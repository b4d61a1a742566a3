"""From commanded thrusts to pulse widths and to the signals of the motors (thesis 3.3.1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.copter.vehicle.multicopter import Multicopter
from diffsim.copter.vehicle.parts.rotors import ROTOR_NAMES, rotor_data
from diffsim.copter.vehicle.rotor import (
    SIGNAL_HIGH,
    SIGNAL_LOW,
    RotorModel,
    rotor_model,
    rotor_names,
)
from diffsim.core.check import require_number
from diffsim.core.checked import checked

SAFE_PWM = 1800.0  # the thesis's clamp, Fig. 3-9 [us]


class Outputs(NamedTuple):
    """Outputs of one control period, (n_rotors,) each."""

    pwm: Tensor  # pulse width of each motor [us]
    thrusts: Tensor  # thrusts that the motors settle at [N]
    saturated: Tensor  # whether the command exceeds the clamp or the motor's limit


class MotorOutputs:
    """The inverse of the measured map from pulse width and voltage to thrust, and its clamp.

    Args:
        rotors: One model per rotor.
        max_thrusts: Rated, (n_rotors,) [N].
        pwm_max: No pulse is longer [us].
    """

    @checked
    def __init__(
        self, rotors: Sequence[RotorModel], max_thrusts: Tensor, *, pwm_max: float = SAFE_PWM
    ):
        if len(rotors) != len(max_thrusts):
            raise ValueError(
                f"rotors must hold one model per rotor, got {len(rotors)} for {len(max_thrusts)}"
            )
        require_number("pwm_max", pwm_max, above=SIGNAL_LOW, at_most=SIGNAL_HIGH)
        self.rotors, self.max_thrusts, self.pwm_max = tuple(rotors), max_thrusts, pwm_max
        names = [r.name for r in rotors]
        self._groups = [  # equal rotors go through their model together
            (rotors[names.index(name)], torch.tensor([k for k, n in enumerate(names) if n == name]))
            for name in dict.fromkeys(names)
        ]
        self._order = torch.cat([idx for _, idx in self._groups]).argsort()

    @checked(voltage=())
    def limits(self, voltage: Tensor) -> Tensor:
        """Largest thrusts at a battery voltage () [V], (n_rotors,) [N]."""
        pwm = torch.full_like(self.max_thrusts, self.pwm_max)
        return torch.minimum(self.thrusts(pwm, voltage), self.max_thrusts)

    @checked(pwm=("n_rotors",), voltage=())
    def thrusts(self, pwm: Tensor, voltage: Tensor) -> Tensor:
        """Settled thrusts at pulse widths, (n_rotors,) [us] and a voltage () [V]."""
        return self._each(lambda rotor, idx: rotor.thrust(rotor.speed_at(pwm[idx], voltage)))

    @checked(wanted=("n_rotors",), voltage=())
    def command(self, wanted: Tensor, voltage: Tensor) -> Outputs:
        """Pulse widths for wanted thrusts, (n_rotors,) [N], at a voltage () [V]."""
        limits = self.limits(voltage)
        thrusts = torch.minimum(wanted.clamp(min=0.0), limits)
        pwm = self._each(lambda rotor, idx: rotor.signal(thrusts[idx], voltage))
        pwm = pwm.clamp(max=self.pwm_max)
        return Outputs(pwm, torch.minimum(self.thrusts(pwm, voltage), limits), wanted >= limits)

    def _each(self, of: Callable[[RotorModel, Tensor], Tensor]) -> Tensor:
        """What each group of equal rotors gives, in the order of the rotors, (n_rotors,)."""
        if len(self._groups) == 1:
            return of(*self._groups[0])
        return torch.cat([of(rotor, idx) for rotor, idx in self._groups])[self._order]

    def standing(self) -> Outputs:
        """All motors off."""
        none = torch.zeros_like(self.max_thrusts)
        return Outputs(torch.full_like(none, SIGNAL_LOW), none, none > 0.0)

    @checked(thrusts=("...", "n_rotors"))
    def power(self, thrusts: Tensor) -> Tensor:
        """Electrical power of all motors (...) [W] at thrusts (..., n_rotors) [N]."""
        power = thrusts.new_zeros(thrusts.shape[:-1])
        for rotor, idx in self._groups:
            power = power + rotor.power(thrusts[..., idx]).sum(-1)
        return power


@checked
def flight_rotors(vehicle: Multicopter) -> tuple[RotorModel, ...]:
    """One bench model per rotor; those of sizes never measured are scaled, and say so.

    Raises:
        ValueError: the vehicle does not name its rotors' models, or one is unknown.
    """
    if not vehicle.rotor_models:
        raise ValueError(
            "vehicle names no rotor models; give rotors=..., one RotorModel per rotor, such as "
            "rotor_model('kde2814_10in')"
        )
    return tuple(_model(name) for name in vehicle.rotor_models)


def _model(name: str) -> RotorModel:
    if name in rotor_names() or name not in ROTOR_NAMES:
        return rotor_model(name)
    part = rotor_data(name)
    measured = [r for r in map(rotor_data, ROTOR_NAMES) if r.measured]
    near = min(measured, key=lambda r: abs(r.radius - part.radius))
    return _scale_model(
        rotor_model(near.name), name, part.radius, part.max_thrust, part.torque_ratio
    )


def _scale_model(
    model: RotorModel, name: str, radius: float, max_thrust: float, torque_ratio: float
) -> RotorModel:
    """The same motor with another propeller: equal signal and speed, thrust in proportion.

    Current by momentum theory: power of a hovering rotor ~ thrust^1.5 / radius.
    """
    gain = max_thrust / model.max_thrust
    current_gain = gain ** (1.5 - model.current_exponent) * model.radius / radius
    return replace(
        model,
        name=name,
        radius=radius,
        torque_ratio=torque_ratio,
        max_thrust=max_thrust,
        thrust_coefficient=gain * model.thrust_coefficient,
        thrust_offset=gain * model.thrust_offset,
        current_coefficient=current_gain * model.current_coefficient,
        assumed=(*model.assumed, "thrust_coefficient", "current_coefficient"),
    )
