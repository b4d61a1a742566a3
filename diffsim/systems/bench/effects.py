"""Effects on a thrust stand's readings, beyond the quadratic rotor."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from diffsim.data.study import Run, Study
from diffsim.identify.effect import Apply, Effect
from diffsim.systems.bench.model import BenchScene, Change, propeller_of, stand_of

PROPELLERS = ("10in", "14in", "prop1", "prop3", "prop4", "prop8")
STANDS = ("kde", "small")
FAST = {"kde": 500.0, "small": 1500.0}  # [rad/s] where a shape of thrust against speed is one
MANY_NEWTON = {"kde": 5.0, "small": 3.0}
DUTY_OF_KNEE = 0.75
# how a quantity changes at an amplitude (..., 1) on a stand
ChangeAt = Callable[[Tensor, str], Change]


def _measures(*wanted: str) -> Callable[[Study], str | None]:
    return partial(_lacks, wanted=wanted)


def _lacks(study: Study, *, wanted: tuple[str, ...]) -> str | None:
    if not any(c.name.split("_")[1] in wanted for c in study.channels):
        return f"a channel of {' or '.join(wanted)}"
    return None


def _per_propeller(quantity: str, change: ChangeAt, owners: tuple[str, ...] = PROPELLERS) -> Apply:
    """Changes a quantity of the stand, with one amplitude per propeller."""
    return partial(_changed, quantity=quantity, change=change, owners=owners, of=propeller_of)


def _per_stand(quantity: str, change: ChangeAt, owners: tuple[str, ...] = STANDS) -> Apply:
    """Changes a quantity of the stand, with one amplitude per stand."""
    return partial(_changed, quantity=quantity, change=change, owners=owners, of=stand_of)


def _changed(
    scene: BenchScene,
    size: Tensor,
    run: Run,
    *,
    quantity: str,
    change: ChangeAt,
    owners: tuple[str, ...],
    of: Callable[[Run], str],
) -> BenchScene:
    own = of(run)
    if own not in owners:
        return scene
    k = size[..., owners.index(own)][..., None]
    return scene.with_change(quantity, change(k, stand_of(run)))


def _thrust_exponent(k: Tensor, stand: str) -> Change:
    return lambda s, x: x * (_speed(s) / FAST[stand]) ** k


def _low_speed_loss(k: Tensor, stand: str) -> Change:
    return lambda s, x: x * (1.0 - k * ((FAST[stand] / _speed(s)) ** 0.5 - 1.0))


def _blade_flexing(k: Tensor, stand: str) -> Change:
    return lambda s, x: x * (1.0 + k * ((_speed(s) / FAST[stand]) ** 2 - 1.0))


def _load_cell_zero(k: Tensor, stand: str) -> Change:
    return lambda s, x: x + k


def _load_cell_scale(k: Tensor, stand: str) -> Change:
    return lambda s, x: x * (1.0 + k)


def _torque_zero(k: Tensor, stand: str) -> Change:
    return lambda s, x: x + torch.where(s.command("speed_rad_s") > 0.0, k, 0.0)


def _torque_exponent(k: Tensor, stand: str) -> Change:
    return lambda s, x: x * (s.of("thrust").clamp(min=1e-3) / MANY_NEWTON[stand]) ** k


def _torque_viscous(k: Tensor, stand: str) -> Change:
    return lambda s, x: x + k * s.command("speed_rad_s")


def _recorded_voltage(k: Tensor, stand: str) -> Change:
    return lambda s, x: x + k * (s.command("voltage_V") - s.run.setup["supply_nominal_V"])


def _supply_resistance(k: Tensor, stand: str) -> Change:
    return lambda s, x: x - k * s.command("current_A")


def _battery_drain(k: Tensor, stand: str) -> Change:
    return lambda s, x: x * (1.0 - k * s.command("reading"))


def _current_limit(scene: BenchScene, size: Tensor, run: Run) -> BenchScene:
    if stand_of(run) not in ("small",):
        return scene
    limit = 1.0 / size[..., :1].clamp(min=1e-4)

    def slowed(s: BenchScene, speed: Tensor) -> Tensor:
        # power ~ speed^3: what the supply cannot give, the speed does not reach
        drawn = s.command("current_A").clamp(min=1e-3)
        return speed * torch.minimum(limit / drawn, torch.ones_like(drawn)) ** (1.0 / 3.0)

    limited = scene.with_change("current", lambda s, x: torch.minimum(x, limit))
    return limited.with_change("speed", slowed)


def _speed_voltage_exponent(k: Tensor, stand: str) -> Change:
    return lambda s, x: x * (s.run.setup["supply_nominal_V"] / 11.1) ** k


def _esc_curve(k: Tensor, stand: str) -> Change:
    return lambda s, x: x * torch.exp(k * (2.0 * s.duty - 1.0) ** 2)


def _esc_knee(k: Tensor, stand: str) -> Change:
    return lambda s, x: x * (1.0 + k * (s.duty - DUTY_OF_KNEE).clamp(min=0.0))


def _current_exponent(k: Tensor, stand: str) -> Change:
    def changed(s: BenchScene, x: Tensor) -> Tensor:
        rest = s._value("current_offset")
        share = (s.command("thrust_N").clamp(min=1e-3) / MANY_NEWTON[stand]) ** k
        return rest + (x - rest) * share

    return changed


def _copper_loss(k: Tensor, stand: str) -> Change:
    return lambda s, x: x + k * x**2


def _speed(scene: BenchScene) -> Tensor:
    """Measured speed, kept off zero: at standstill there is no thrust to change."""
    return scene.command("speed_rad_s").clamp(min=20.0)


THRUST_EXPONENT = Effect(
    name="thrust_exponent",
    form="Thrust ~ speed^(2 + size).",
    family="thrust_law",
    kind="force",
    unit="-",
    typical=0.1,
    components=PROPELLERS,
    also_looks_like=(
        "lift coefficient that rises with the Reynolds number",
        "twist of the blades under load",
    ),
    needs=_measures("thrust"),
    apply=_per_propeller("thrust", _thrust_exponent),
)
LOW_SPEED_LOSS = Effect(
    name="low_speed_loss",
    form="Thrust coefficient lower by size (sqrt(w_fast / w) - 1): viscous, ~ Reynolds^-1/2.",
    family="thrust_law",
    kind="force",
    unit="-",
    typical=0.05,
    components=PROPELLERS,
    also_looks_like=("laminar separation on the blades", "zero of the load cell"),
    needs=_measures("thrust"),
    apply=_per_propeller("thrust", _low_speed_loss),
)
BLADE_FLEXING = Effect(
    name="blade_flexing",
    form="Thrust coefficient grows by size (w / w_fast)^2: twist or coning under load.",
    family="thrust_law",
    kind="force",
    unit="-",
    typical=0.1,
    components=PROPELLERS,
    also_looks_like=("compressibility at the tips",),
    needs=_measures("thrust"),
    apply=_per_propeller("thrust", _blade_flexing),
)
LOAD_CELL_ZERO = Effect(
    name="load_cell_zero",
    form="Thrust reads size too much.",
    family="zero",
    kind="sensor",
    unit="N",
    typical=0.02,
    components=PROPELLERS,
    needs=_measures("thrust"),
    apply=_per_propeller("thrust", _load_cell_zero),
)
LOAD_CELL_SCALE = Effect(
    name="load_cell_scale",
    form="Thrust reads 1 + size times too much: the thrust coefficients say the same.",
    family="scale",
    kind="sensor",
    unit="-",
    typical=0.05,
    components=STANDS,
    also_looks_like=("density of the air", "thrust coefficient"),
    needs=_measures("thrust"),
    apply=_per_stand("thrust", _load_cell_scale),
)
TORQUE_ZERO = Effect(
    name="torque_offset",
    form="Torque reads size too much while the rotor turns.",
    family="torque_law",
    kind="force",
    unit="N m",
    typical=0.0005,
    components=("10in", "14in"),
    also_looks_like=("dry friction of the bearings", "zero of the torque cell"),
    needs=_measures("torque"),
    apply=_per_propeller("torque", _torque_zero, ("10in", "14in")),
)
TORQUE_EXPONENT = Effect(
    name="torque_exponent",
    form="Torque ~ thrust^(1 + size).",
    family="torque_law",
    kind="force",
    unit="-",
    typical=0.05,
    components=("10in", "14in"),
    also_looks_like=("drag coefficient that falls with the Reynolds number",),
    needs=_measures("torque"),
    apply=_per_propeller("torque", _torque_exponent, ("10in", "14in")),
)
TORQUE_VISCOUS = Effect(
    name="torque_viscous",
    form="Torque plus size w: friction of air gap and bearings.",
    family="torque_law",
    kind="force",
    unit="N m s",
    typical=2e-06,
    components=("10in", "14in"),
    needs=_measures("torque"),
    apply=_per_propeller("torque", _torque_viscous, ("10in", "14in")),
)
RECORDED_VOLTAGE = Effect(
    name="recorded_voltage",
    form="Voltage departs from nominal by size times what was recorded; 1: as recorded.",
    family="voltage",
    kind="actuator",
    unit="-",
    typical=1.0,
    components=("small",),
    needs=_measures("speed", "current"),
    apply=_per_stand("voltage", _recorded_voltage, ("small",)),
)
SUPPLY_RESISTANCE = Effect(
    name="supply_resistance",
    form="Voltage falls by size times the measured current.",
    family="voltage",
    kind="actuator",
    unit="Ohm",
    typical=0.03,
    signed=False,
    components=STANDS,
    also_looks_like=("resistance of the wires", "speed exponent, where no voltage is recorded"),
    needs=_measures("speed", "current"),
    apply=_per_stand("voltage", _supply_resistance),
)
BATTERY_DRAIN = Effect(
    name="battery_drain",
    form="Voltage falls by the share size with each reading.",
    family="voltage",
    kind="actuator",
    unit="-",
    typical=0.002,
    signed=False,
    components=("kde",),
    also_looks_like=("warming of motor and controller", "speed exponent in a single sweep"),
    needs=_measures("speed", "current"),
    apply=_per_stand("voltage", _battery_drain, ("kde",)),
)
CURRENT_LIMIT = Effect(
    name="current_limit",
    form="The supply gives no more than 1 / size: speed and current stay at what that allows.",
    family="limit",
    kind="actuator",
    unit="1/A",
    typical=0.05,
    signed=False,
    components=("small",),
    smooth=False,
    needs=_measures("current"),
    apply=_current_limit,
)
SPEED_VOLTAGE_EXPONENT = Effect(
    name="speed_voltage_exponent",
    form="Speed times the nominal voltage to the power size, beside the motor's law.",
    family="speed_law",
    kind="actuator",
    unit="-",
    typical=0.2,
    components=("small",),
    needs=_measures("speed"),
    apply=_per_stand("speed", _speed_voltage_exponent, ("small",)),
)
ESC_CURVE = Effect(
    name="esc_curve",
    form="Speed times exp(size x^2), x the signal from -1 to 1.",
    family="speed_law",
    kind="actuator",
    unit="-",
    typical=0.05,
    components=STANDS,
    needs=_measures("speed"),
    apply=_per_stand("speed", _esc_curve),
)
ESC_KNEE = Effect(
    name="esc_knee",
    form="Speed grows by size times the duty above 0.75: advance of the commutation, say.",
    family="speed_law",
    kind="actuator",
    unit="-",
    typical=0.2,
    components=STANDS,
    needs=_measures("speed"),
    apply=_per_stand("speed", _esc_knee),
)
CURRENT_EXPONENT = Effect(
    name="power_exponent",
    form="Electrical power ~ thrust^(1.5 + size).",
    family="current_law",
    kind="actuator",
    unit="-",
    typical=0.1,
    components=STANDS,
    also_looks_like=("efficiency of the motor that changes with load",),
    needs=_measures("current"),
    apply=_per_stand("current", _current_exponent),
)
COPPER_LOSS = Effect(
    name="copper_loss",
    form="Current grows by size times its square: R / V of the motor's heat.",
    family="current_law",
    kind="actuator",
    unit="1/A",
    typical=0.01,
    components=STANDS,
    needs=_measures("current"),
    apply=_per_stand("current", _copper_loss),
)

BENCH: tuple[Effect, ...] = (
    THRUST_EXPONENT,
    LOW_SPEED_LOSS,
    BLADE_FLEXING,
    LOAD_CELL_ZERO,
    LOAD_CELL_SCALE,
    TORQUE_ZERO,
    TORQUE_EXPONENT,
    TORQUE_VISCOUS,
    RECORDED_VOLTAGE,
    SUPPLY_RESISTANCE,
    BATTERY_DRAIN,
    CURRENT_LIMIT,
    SPEED_VOLTAGE_EXPONENT,
    ESC_CURVE,
    ESC_KNEE,
    CURRENT_EXPONENT,
    COPPER_LOSS,
)
