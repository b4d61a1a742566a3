"""Candidate causes of a multicopter: those that its recording can show, in its frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from torch import Tensor

from diffsim.causes.catalogue import rows
from diffsim.causes.commands import ACTUATOR, CommandGroup, command_cause, command_causes
from diffsim.causes.ports import SignalChange, on_commands, on_numbers
from diffsim.causes.readings import SENSOR
from diffsim.causes.scales import Scales
from diffsim.copter import GRAVITY
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Apply, Effect
from diffsim.systems.multicopter import effects, loads, moments, rotors
from diffsim.systems.multicopter.flight import rotor_names
from diffsim.systems.multicopter.frames import Frames
from diffsim.systems.multicopter.lag import speed_lagged
from diffsim.systems.multicopter.scene import CopterScene

SYSTEM = "multicopter"  # as tables call this kind of system
_CAMERAS = {"position", "velocity", "attitude", "quaternion"}
_NORTH_EAST = {
    "components": ("north", "east"),
    "form": "Constant force in the world, north and east.",
}
_ACTS: Mapping[str, Apply] = {
    "parasitic_drag": effects.drag_by_square,
    "rotor_speed_drag": rotors.drag_by_rotor_speed,
    "gust": loads.push_in_gusts,
    "body_tilt": effects.tilt_rotors,
    "slung_load": loads.hang_load,
    "voltage_exponent": effects.follow_voltage,
    "thrust_curvature": effects.curve_thrust,
    "ground_effect": effects.push_near_ground,
    "inflow": effects.lose_thrust_in_climb,
    "wake": effects.lose_thrust_in_wake,
    "gyroscopic": effects.turn_with_spin,
    "spin_up": moments.turn_with_rotor_speed,
    "flow_moment": moments.pitch_in_flow,
    "climb_moment": moments.pitch_less_in_climb,
    "rate_damping": moments.damp_rates,
    "blind_estimator": effects.estimate_without_drag,
    "placement": partial(effects.add_to_vector, vector="placement"),
    "sensor_tilt": partial(effects.add_to_vector, vector="sensor_tilt"),
}
_OF_ROTOR = {
    "thrust_loss": rotors.lose_thrust,
    "torque_loss": rotors.lose_torque,
    "rotor_tilt": rotors.tilt_rotor,
}
_LIBRARY = (
    *("rotor_drag", "body_drag", "parasitic_drag", "wind", "body_tilt", "voltage_exponent"),
    *("center_of_mass", "ground_effect", "inflow", "wake", "thrust_curvature", "gyroscopic"),
    *("placement", "sensor_tilt", "sensor_scale", "accelerometer_scale", "gyro_offset"),
)


@dataclass(frozen=True, kw_only=True)
class Vehicle:
    """What decides which causes there are, and how large they may be.

    Attributes:
        num_rotors: Number of rotors.
        mass: [kg].
        arm: Largest distance of a rotor from the center of mass [m].
        frames: Frames of the recording.
        sensors: Groups of readings.
        has_radius: Whether the size of the propellers is known.
        has_lag: Whether a lag of the motors is fitted already.
        has_clock: Whether the clock of the commands is fitted already.
        has_center: Whether the center of mass is fitted already.
        has_mass: Whether a mass of which little is known is fitted already.
        has_speed: Whether commands tell the rotors' speed in rad/s.
        lags_speed: Whether it is the speed, not the thrust, that lags.
        battery: Name of the command that is the battery's voltage; None: none.
        has_estimator: Whether an estimator shows velocity and attitude.
        states_sensors: Whether channels say which sensor shows them: each has a clock then.
        has_thrust: Whether commands tell the rotors' thrust, not a speed or a throttle.
    """

    num_rotors: int
    mass: float
    arm: float
    frames: Frames
    sensors: tuple[str, ...]
    has_radius: bool
    has_lag: bool
    has_clock: bool
    has_center: bool
    has_mass: bool
    has_speed: bool
    lags_speed: bool
    battery: str | None
    has_estimator: bool = False
    states_sensors: bool = False
    has_thrust: bool = False

    @property
    def scales(self) -> dict[str, float]:
        """Usual magnitudes."""
        return usual_scales(self.mass, self.arm, self.num_rotors)

    @property
    def thrusts(self) -> CommandGroup:
        """What all rotors are asked for."""
        return _list_asked_thrusts(self.scales)


def candidate_causes(of: Vehicle) -> tuple[Effect, ...]:
    """All candidates, their usual sizes by the mass and size of the vehicle."""
    out = [flight_cause(name, of.scales, **_find_own_words(name, of)) for name in _list_names(of)]
    if of.has_thrust:
        out.insert(0, command_cause("quantization", of.thrusts, system=SYSTEM))
    out += rotor_causes(of.num_rotors)
    if not of.has_lag:
        out.append(speed_lag() if of.lags_speed else command_cause("lag", of.thrusts))
    if not of.has_clock:
        out.append(command_cause("delay", of.thrusts, system=SYSTEM))
    return tuple(out)


def offered_causes(of: Vehicle, scales: Scales) -> list[Effect]:
    """What else commands may meet on their way, for studies that ask for it by name.

    Args:
        of: What decides which causes there are.
        scales: Usual magnitudes.
    """
    thrusts = {**scales.of_commands(rotor_names(of.num_rotors)), **of.scales}
    group = replace(of.thrusts, scales=thrusts)
    return command_causes(group, system=SYSTEM, without=("lag", "delay"))


def copter_library(num_rotors: int = 4) -> tuple[Effect, ...]:
    """Causes in flights; those of single rotors once for each.

    Args:
        num_rotors: Number of rotors.
    """
    usual = usual_scales(1.0, 0.25, num_rotors)
    thrusts = _list_asked_thrusts(usual)
    needed = {"voltage_exponent": _needs_voltage, "gyroscopic": _needs_four_rotors}
    return (
        command_cause("quantization", thrusts, system=SYSTEM),
        *(
            flight_cause(
                name,
                usual,
                **(_NORTH_EAST if name == "wind" else {}),
                **({"needs": needed[name]} if name in needed else {}),
            )
            for name in _LIBRARY
        ),
        command_cause("lag", thrusts),
        command_cause("delay", thrusts, system=SYSTEM),
        *rotor_causes(num_rotors),
    )


def flight_cause(name: str, scales: Mapping[str, float], **own: Any) -> Effect:
    """One cause in flight, in the vehicle or in what it shows.

    Args:
        name: Name of its row.
        scales: As of ``usual_scales``.
        **own: Fields of the effect that differ from the row.
    """
    if name == "sensor_scale":
        return _make_position_scale()
    row = next(rows(table)[name] for table in ("flight", "camera") if name in rows(table))
    if row.at == "number":
        own = {"apply": on_numbers(row), **own}
    elif row.at == "command":
        own = {"apply": on_commands(row, ()), **own}
    return row.effect(**{"apply": _ACTS.get(name), "scales": scales, "system": SYSTEM, **own})


def rotor_causes(num_rotors: int) -> list[Effect]:
    """All causes of single rotors, rotor after rotor.

    Args:
        num_rotors: Number of rotors.
    """
    return [
        _make_rotor_cause(name, index, rotor)
        for index, rotor in enumerate(rotor_names(num_rotors))
        for name in ("weak_rotor", *_OF_ROTOR)
    ]


def _make_rotor_cause(name: str, index: int, rotor: str) -> Effect:
    row = rows("flight")[name]
    if row.at == "command":
        apply = on_commands(row, (rotor,))
    else:
        apply = partial(_OF_ROTOR[name], index=index)
    return row.effect(apply, ending=f"_{index + 1}")


def speed_lag() -> Effect:
    """The lag of actuators, of the rotors' speed instead of their thrust."""
    form = "First-order lag of the rotors' speed, with the time constant size."
    return rows(ACTUATOR)["lag"].effect(_lag_speeds, form=form)


def usual_scales(mass: float, arm: float, num_rotors: int) -> dict[str, float]:
    """Magnitudes of a vehicle by the names that tables of causes use.

    Args:
        mass: [kg].
        arm: Largest distance of a rotor from the center of mass [m].
        num_rotors: Number of rotors.

    Returns:
        ``mass``, ``arm``, and ``lift``: thrust of a rotor half above what hover needs [N].
    """
    return {"mass": mass, "arm": arm, "lift": 1.5 * mass * GRAVITY / num_rotors}


def acting_in(effect: Effect, facts: Mapping[str, str | float]) -> Effect:
    """The effect in those runs only whose set-up states some facts.

    Args:
        effect: Candidate cause.
        facts: Values by name of the fact, such as {"propeller": "cut"}.
    """
    return replace(effect, apply=partial(_apply_there, inner=effect.apply, facts=dict(facts)))


def _apply_there(
    scene: CopterScene,
    size: Tensor,
    run: Run,
    *,
    inner: Callable[[CopterScene, Tensor, Run], CopterScene],
    facts: Mapping[str, str | float],
) -> CopterScene:
    is_there = all(run.setup.get(fact) == value for fact, value in facts.items())
    return inner(scene, size, run) if is_there else scene


def _list_names(of: Vehicle) -> Iterator[str]:
    """Rows that a flight can show, without those of single rotors and of commands."""
    yield from ("rotor_drag", "body_drag", "parasitic_drag", "wind", "body_tilt")
    yield from ("inflow", "wake", "thrust_curvature")
    yield from _names_in_vehicle(of)
    yield from _names_in_sensors(of)


def _names_in_vehicle(of: Vehicle) -> Iterator[str]:
    yield from ("slung_load", "gust")
    if not of.has_mass:
        yield "extra_mass"
    if of.has_speed:
        yield "rotor_speed_drag"
    if of.has_speed and of.num_rotors >= 4:  # small torques show where speeds were measured
        yield from ("flow_moment", "climb_moment", "rate_damping", "spin_up")
    if not of.has_center:
        yield "center_of_mass"
    if of.num_rotors >= 4:
        yield "gyroscopic"
    if of.battery is not None:
        yield "voltage_exponent"
    elif not of.has_speed:  # a speed that was measured has fallen already
        yield "battery_sag"
    if of.has_radius and "position" in of.sensors:
        yield "ground_effect"


def _names_in_sensors(of: Vehicle) -> Iterator[str]:
    force = {"accelerometer", "specific_force_in_world", "acceleration"} & set(of.sensors)
    if "position" in of.sensors:
        yield from ("placement", "sensor_scale")
        if "velocity" in of.sensors:  # two sensors whose scales may disagree
            yield "ground_scale"
            if of.has_estimator:
                yield "blind_estimator"
    if "body_rates" in of.sensors:
        yield "gyro_offset"
    has_unit = "body_rates" in of.sensors or force
    if has_unit:
        yield "sensor_tilt"
    if has_unit and _CAMERAS & set(of.sensors) and not of.states_sensors:
        yield "camera_delay"
    if force:
        yield "accelerometer_scale"


def _find_own_words(name: str, of: Vehicle) -> dict[str, Any]:
    """What a cause's row says otherwise of this vehicle."""
    if name == "wind" and of.frames.world == "NED":
        return _NORTH_EAST
    if name == "voltage_exponent" and of.battery is not None:
        needs = partial(_needs_voltage, name=of.battery)
        return {"needs": needs, "apply": partial(effects.follow_voltage, name=of.battery)}
    return {}


def _make_position_scale() -> Effect:
    return rows(SENSOR)["sensor_scale"].effect(
        _scale_positions,
        typical=0.02,
        form="The captured position is larger by the share size.",
        also_looks_like=("thrust gain and mass in vertical flight",),
    )


def _scale_positions(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    return scene.with_number("position_scale", lambda value: value * (1.0 + size[..., 0]))


def _lag_speeds(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    return scene.with_command((), SignalChange(speed_lagged, size))


def _list_asked_thrusts(scales: Mapping[str, float]) -> CommandGroup:
    """Thrusts that all rotors are asked for: never below zero."""
    return CommandGroup((), scales, "held", is_one_sided=True, unit="N")


def _needs_voltage(study: Study, *, name: str = effects.VOLTAGE) -> str | None:
    if all(name in run.command for run in study.runs):
        return None
    return f"the battery's voltage in every run (command {name})"


def _needs_four_rotors(study: Study) -> str | None:
    if int(study.metadata.get("num_rotors", 4)) < 4:
        return "four rotors or more"
    return None
