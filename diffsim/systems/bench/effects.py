"""What a thrust stand's readings may have beyond the quadratic rotor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch import Tensor

from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.systems.bench.model import BenchScene, Change, propeller_of, stand_of

PROPELLERS = ("10in", "14in", "prop1", "prop3", "prop4", "prop8")
STANDS = ("kde", "small")
FAST = {"kde": 500.0, "small": 1500.0}  # [rad/s] where a shape of thrust against speed is one
MANY_NEWTON = {"kde": 5.0, "small": 3.0}
DUTY_OF_KNEE = 0.75


class BenchEffect(Effect):
    """Changes one quantity; one amplitude per propeller or stand, ``component_of`` a run."""

    quantity: str
    kind, unit = "force", "-"
    component_of: Callable[[Run], str] = staticmethod(propeller_of)
    components: ClassVar[tuple[str, ...]] = PROPELLERS

    def needs(self, study: Study) -> str | None:
        wanted = ("speed", "current") if self.quantity == "voltage" else (self.quantity,)
        if not any(c.name.split("_")[1] in wanted for c in study.channels):
            return f"a channel of {' or '.join(wanted)}"
        return None

    def apply(self, scene: BenchScene, size: Tensor, run: Run) -> Any:
        own = type(self).component_of(run)
        if own not in self.components:
            return scene
        k = size[..., self.components.index(own)][..., None]
        return scene.with_change(self.quantity, self.change(k, stand_of(run)))

    def change(self, k: Tensor, stand: str) -> Change:
        """How the quantity changes at the amplitude k, (..., 1)."""
        raise NotImplementedError


class ThrustExponent(BenchEffect):
    """Thrust ~ speed^(2 + size)."""

    name, family, typical, quantity = "thrust_exponent", "thrust law", 0.1, "thrust"
    also_looks_like = (
        "lift coefficient that rises with the Reynolds number",
        "twist of the blades under load",
    )

    def change(self, k: Tensor, stand: str) -> Change:
        return lambda s, x: x * (_speed(s) / FAST[stand]) ** k


class LowSpeedLoss(BenchEffect):
    """Thrust coefficient lower by size (sqrt(w_fast / w) - 1): viscous, ~ Reynolds^-1/2."""

    name, family, typical, quantity = "low_speed_loss", "thrust law", 0.05, "thrust"
    also_looks_like = ("laminar separation on the blades", "zero of the load cell")

    def change(self, k: Tensor, stand: str) -> Change:
        return lambda s, x: x * (1.0 - k * ((FAST[stand] / _speed(s)) ** 0.5 - 1.0))


class BladeFlexing(BenchEffect):
    """Thrust coefficient grows by size (w / w_fast)^2: twist or coning under load."""

    name, family, typical, quantity = "blade_flexing", "thrust law", 0.1, "thrust"
    also_looks_like = ("compressibility at the tips",)

    def change(self, k: Tensor, stand: str) -> Change:
        return lambda s, x: x * (1.0 + k * ((_speed(s) / FAST[stand]) ** 2 - 1.0))


class LoadCellZero(BenchEffect):
    """Thrust reads size too much."""

    name, family, typical, quantity = "load_cell_zero", "zero", 0.02, "thrust"
    kind, unit = "sensor", "N"

    def change(self, k: Tensor, stand: str) -> Change:
        return lambda s, x: x + k


class LoadCellScale(BenchEffect):
    """Thrust reads 1 + size times too much: the thrust coefficients say the same."""

    name, family, typical, quantity, kind = "load_cell_scale", "scale", 0.05, "thrust", "sensor"
    component_of, components = staticmethod(stand_of), STANDS
    also_looks_like = ("density of the air", "thrust coefficient")

    def change(self, k: Tensor, stand: str) -> Change:
        return lambda s, x: x * (1.0 + k)


class TorqueZero(BenchEffect):
    """Torque reads size too much while the rotor turns."""

    name, family, typical, quantity = "torque_offset", "torque law", 0.0005, "torque"
    unit, components = "N m", ("10in", "14in")
    also_looks_like = ("dry friction of the bearings", "zero of the torque cell")

    def change(self, k: Tensor, stand: str) -> Change:
        return lambda s, x: x + torch.where(s.command("speed_rad_s") > 0.0, k, 0.0)


class TorqueExponent(BenchEffect):
    """Torque ~ thrust^(1 + size)."""

    name, family, typical, quantity = "torque_exponent", "torque law", 0.05, "torque"
    components = ("10in", "14in")
    also_looks_like = ("drag coefficient that falls with the Reynolds number",)

    def change(self, k: Tensor, stand: str) -> Change:
        return lambda s, x: x * (s.of("thrust").clamp(min=1e-3) / MANY_NEWTON[stand]) ** k


class TorqueViscous(BenchEffect):
    """Torque plus size w: friction of air gap and bearings."""

    name, family, typical, quantity = "torque_viscous", "torque law", 2e-6, "torque"
    unit, components = "N m s", ("10in", "14in")

    def change(self, k: Tensor, stand: str) -> Change:
        return lambda s, x: x + k * s.command("speed_rad_s")


class StandEffect(BenchEffect):
    """One amplitude per stand."""

    components: ClassVar[tuple[str, ...]] = STANDS
    component_of, kind = staticmethod(stand_of), "actuator"


class RecordedVoltage(StandEffect):
    """Voltage departs from nominal by size times what was recorded; 1: as recorded."""

    name, family, typical, quantity = "recorded_voltage", "voltage", 1.0, "voltage"
    components = ("small",)

    def change(self, k: Tensor, stand: str) -> Change:
        return lambda s, x: x + k * (s.command("voltage_V") - s.run.setup["supply_nominal_V"])


class SupplyResistance(StandEffect):
    """Voltage falls by size times the measured current."""

    name, family, unit, typical, quantity = (
        "supply_resistance",
        "voltage",
        "Ohm",
        0.03,
        "voltage",
    )
    signed = False
    also_looks_like = ("resistance of the wires", "speed exponent, where no voltage is recorded")

    def change(self, k: Tensor, stand: str) -> Change:
        return lambda s, x: x - k * s.command("current_A")


class BatteryDrain(StandEffect):
    """Voltage falls by the share size with each reading."""

    name, family, typical, quantity = "battery_drain", "voltage", 0.002, "voltage"
    components, signed = ("kde",), False
    also_looks_like = ("warming of motor and controller", "speed exponent in a single sweep")

    def change(self, k: Tensor, stand: str) -> Change:
        return lambda s, x: x * (1.0 - k * s.command("reading"))


class CurrentLimit(StandEffect):
    """The supply gives no more than 1 / size: speed and current stay at what that allows."""

    name, family, unit, typical, quantity = "current_limit", "limit", "1/A", 0.05, "current"
    components, signed, smooth = ("small",), False, False

    def apply(self, scene: BenchScene, size: Tensor, run: Run) -> Any:
        if stand_of(run) not in self.components:
            return scene
        limit = 1.0 / size[..., :1].clamp(min=1e-4)

        def slowed(s: BenchScene, speed: Tensor) -> Tensor:
            # power ~ speed^3: what the supply cannot give, the speed does not reach
            drawn = s.command("current_A").clamp(min=1e-3)
            return speed * torch.minimum(limit / drawn, torch.ones_like(drawn)) ** (1.0 / 3.0)

        limited = scene.with_change("current", lambda s, x: torch.minimum(x, limit))
        return limited.with_change("speed", slowed)


class VoltageExponent(StandEffect):
    """Speed times the nominal voltage to the power size, beside the motor's law."""

    name, family, typical, quantity = "voltage_exponent", "speed law", 0.2, "speed"
    components = ("small",)

    def change(self, k: Tensor, stand: str) -> Change:
        return lambda s, x: x * (s.run.setup["supply_nominal_V"] / 11.1) ** k


class EscCurve(StandEffect):
    """Speed times exp(size x^2), x the signal from -1 to 1."""

    name, family, typical, quantity = "esc_curve", "speed law", 0.05, "speed"

    def change(self, k: Tensor, stand: str) -> Change:
        return lambda s, x: x * torch.exp(k * (2.0 * s.duty - 1.0) ** 2)


class EscKnee(StandEffect):
    """Speed grows by size times the duty above 0.75: advance of the commutation, say."""

    name, family, typical, quantity = "esc_knee", "speed law", 0.2, "speed"

    def change(self, k: Tensor, stand: str) -> Change:
        return lambda s, x: x * (1.0 + k * (s.duty - DUTY_OF_KNEE).clamp(min=0.0))


class CurrentExponent(StandEffect):
    """Electrical power ~ thrust^(1.5 + size)."""

    name, family, typical, quantity = "power_exponent", "current law", 0.1, "current"
    components = ("kde", "small")
    also_looks_like = ("efficiency of the motor that changes with load",)

    def change(self, k: Tensor, stand: str) -> Change:
        def changed(s: BenchScene, x: Tensor) -> Tensor:
            rest = s._value("current_offset")
            share = (s.command("thrust_N").clamp(min=1e-3) / MANY_NEWTON[stand]) ** k
            return rest + (x - rest) * share

        return changed


class CopperLoss(StandEffect):
    """Current grows by size times its square: R / V of the motor's heat."""

    name, family, unit, typical, quantity = "copper_loss", "current law", "1/A", 0.01, "current"

    def change(self, k: Tensor, stand: str) -> Change:
        return lambda s, x: x + k * x**2


BENCH: tuple[type[BenchEffect], ...] = (
    ThrustExponent,
    LowSpeedLoss,
    BladeFlexing,
    LoadCellZero,
    LoadCellScale,
    TorqueZero,
    TorqueExponent,
    TorqueViscous,
    RecordedVoltage,
    SupplyResistance,
    BatteryDrain,
    CurrentLimit,
    VoltageExponent,
    EscCurve,
    EscKnee,
    CurrentExponent,
    CopperLoss,
)


def _speed(scene: BenchScene) -> Tensor:
    """Measured speed, kept off zero: at standstill there is no thrust to change."""
    return scene.command("speed_rad_s").clamp(min=20.0)
