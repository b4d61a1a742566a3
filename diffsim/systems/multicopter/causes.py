"""What a multicopter tells of itself to causes, and what its own functions do."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any

from torch import Tensor

from diffsim.causes.channel_groups import channel_groups, channels_of
from diffsim.causes.commands import CommandGroup
from diffsim.causes.plant import IN_TIME, Place, Plant
from diffsim.causes.ports import SignalChange
from diffsim.causes.readings import Instrument, instrument_of, usual_sample
from diffsim.causes.row import spell_plainly
from diffsim.causes.scales import Scales
from diffsim.copter import GRAVITY
from diffsim.core.checked import checked
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Apply, Effect
from diffsim.systems.multicopter import effects
from diffsim.systems.multicopter.assembly import VEHICLE
from diffsim.systems.multicopter.cutting import Cutter
from diffsim.systems.multicopter.described import DescribedFlights
from diffsim.systems.multicopter.frames import AXES, SENSORS
from diffsim.systems.multicopter.keys import MulticopterKeys
from diffsim.systems.multicopter.lag import speed_lagged
from diffsim.systems.multicopter.scene import NUMBERS, CopterScene, rotor_names

SYSTEM = "multicopter"  # the kind of system, and its table
_TURNS = {"attitude", "quaternion"}  # what has no scale, no zero and no lag by itself
_ALREADY = {  # causes of whole groups that every vehicle has
    "sensor_scale": ("position", "accelerometer"),
    "sensor_offset": ("position", "body_rates", "accelerometer", "acceleration"),
}
_USUAL = {"m": 0.05, "m/s": 0.05, "rad/s": 0.02, "m/s^2": 0.1}  # a zero that is no surprise


def _lag_speeds(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    return scene.with_command((), SignalChange(speed_lagged, size))


def _act_on_rotor(act: Callable[..., Any], rotor: str, name: str) -> Apply:
    return partial(act, rotor=rotor)


#: What causes do that no port says, by the names of their rows.
FUNCTIONS: Mapping[str, Apply] = MappingProxyType(
    {
        "parasitic_drag": effects.drag_by_square,
        "rotor_speed_drag": effects.drag_by_rotor_speed,
        "gust": effects.push_in_gusts,
        "body_tilt": effects.tilt_rotors,
        "slung_load": effects.hang_load,
        "voltage_exponent": effects.follow_voltage,
        "thrust_curvature": effects.curve_thrust,
        "ground_effect": effects.push_near_ground,
        "inflow": effects.lose_thrust_in_climb,
        "wake": effects.lose_thrust_in_wake,
        "gyroscopic": effects.turn_with_spin,
        "spin_up": effects.turn_with_rotor_speed,
        "flow_moment": effects.pitch_in_flow,
        "climb_moment": effects.pitch_less_in_climb,
        "rate_damping": effects.damp_rates,
        "blind_estimator": effects.estimate_without_drag,
        "thrust_loss": partial(_act_on_rotor, effects.lose_thrust),
        "torque_loss": partial(_act_on_rotor, effects.lose_torque),
        "rotor_tilt": partial(_act_on_rotor, effects.tilt_rotor),
        "lag": _lag_speeds,  # in place of the port's where the rotors' speed lags
    }
)


@checked
def copter_plant(
    num_rotors: int,
    mass: float,
    arm: float,
    facts: Collection[str],
    *,
    scales: Scales | None = None,
    functions: Mapping[str, Apply] = FUNCTIONS,
    **more: Any,
) -> Plant:
    """A vehicle as causes see it.

    Args:
        num_rotors: Number of rotors.
        mass: Mass [kg].
        arm: Largest distance of a rotor from the center of mass [m].
        facts: What holds of it, as the table of multicopters calls it.
        scales: Usual magnitudes of the recordings; None: there are none.
        functions: What rows do that no port says.
        **more: Further entries of the plant.
    """
    names = rotor_names(num_rotors)
    scales = scales or Scales({}, {}, 0.0, 1)
    usual = {"mass": mass, "arm": arm, "lift": 1.5 * mass * GRAVITY / num_rotors}
    thrusts = {**scales.of_commands(names), **usual}
    return Plant(
        **{
            "kind": SYSTEM,
            "scales": scales,
            "channels": (),
            "commands": dict.fromkeys(names, "held"),
            "ways": (CommandGroup((), thrusts, "held", is_one_sided=True, unit="N"),),
            "numbers": NUMBERS,
            "facts": {IN_TIME: True, "four_rotors": num_rotors >= 4, **dict.fromkeys(facts, True)},
            "parts": {"rotor": {str(i + 1): name for i, name in enumerate(names)}},
            "functions": functions,
            "magnitudes": usual,
            "instruments": (),
            **more,
        }
    )


def plant_of(
    given: MulticopterKeys, flights: DescribedFlights, study: Study, scales: Scales
) -> Plant:
    """What a described multicopter tells of itself.

    Args:
        scales: Usual magnitudes.
    """
    functions = dict(FUNCTIONS)
    if given.battery is not None:
        functions["voltage_exponent"] = partial(effects.follow_voltage, name=given.battery)
    vehicle, fleet = scales.plain[VEHICLE], flights.nominal_fleet()
    facts = {**_list_facts(given, flights), **_list_seen(flights.cutter.sensors)}
    facts["states_sensors"] = any(c.sensor is not None for c in study.channels)
    facts["radius"] = bool((fleet.radii > 0.0).all())
    return copter_plant(
        fleet.num_rotors,
        vehicle["mass"],
        vehicle["arm"],
        [fact for fact, holds in facts.items() if holds],
        scales=scales,
        functions=functions,
        channels=study.channels,
        places={axis: Place(scales.plain[axis]) for axis in AXES},
        instruments=tuple(_list_instruments(given, study, flights.cutter, scales)),
        sample_s=usual_sample(study.runs),
    )


def _list_facts(given: MulticopterKeys, flights: DescribedFlights) -> dict[str, bool]:
    q, meaning = flights.parameters.quantities, given.commands.meaning
    everywhere = not given.causes_act_in  # else a cause is of some runs, what is fitted of all
    return {
        "thrusts": meaning == "thrust",
        "speeds": meaning == "speed" and flights.law.is_squared,
        "lags_speed": flights.lags_speed,
        "lag_is_fitted": "motor_lag" in q and q["motor_lag"].is_fitted,
        "clock_is_fitted": "clock" in q,
        "center_is_fitted": everywhere and any(q[f"center_of_mass_{a}"].is_fitted for a in "xy"),
        "mass_is_fitted": everywhere
        and q["mass"].is_fitted
        # a mass no better known needs no cause that adds to it
        and (q["mass"].percent or 0.0) >= 5.0,
        "battery": given.battery is not None,
        "estimator": given.estimator is not None,
        "down": flights.cutter.frames.world == "NED",
        "asked": given.effects.only is not None,
    }


def _list_seen(sensors: Collection[str]) -> dict[str, bool]:
    """What groups of readings show."""
    cameras = {"position", "velocity", "attitude", "quaternion"}
    forces = {"accelerometer", "specific_force_in_world", "acceleration"}
    rates, force = "body_rates" in sensors, not forces.isdisjoint(sensors)
    return {
        "sees_position": "position" in sensors,
        "sees_velocity": "velocity" in sensors,
        "sees_camera": not cameras.isdisjoint(sensors),
        "sees_rates": rates,
        "sees_force": force,
        "sees_unit": rates or force,
    }


def _list_instruments(
    given: MulticopterKeys, study: Study, cutter: Cutter, scales: Scales
) -> Iterator[Instrument]:
    """Each stated sensor; what a vehicle has without a statement stays."""
    if all(c.sensor is None for c in study.channels):
        return
    groups = [group for group in cutter.sensors for _ in SENSORS[group]]
    shown = [groups[k] for k in (range(len(groups)) if cutter.columns is None else cutter.columns)]
    clocks = [channels_of(study.channels, name) for name in given.clocks]
    for group in channel_groups(study.channels, late_record=False):
        if len(group.channels) == len(study.channels):
            continue  # of all channels: the clock of the commands
        of = instrument_of(group, study.channels, scales)
        own = {shown[k] for k in of.places}
        left_out = {"sensor_delay"} if group.channels in clocks else set()
        if own & _TURNS:
            left_out |= {name for name in group.causes if name != "sensor_delay"}
        if len(own) == 1 and [k for k, g in enumerate(shown) if g in own] == [*of.places]:
            left_out |= {name for name, there in _ALREADY.items() if own <= {*there}}
        yield replace(
            of,
            scales={**of.scales, "usual": _USUAL.get(of.unit, 1.0)},
            ending=f"_of_{spell_plainly(group.name)}",
            causes=tuple(name for name in group.causes if name not in left_out),
        )


def acting_in(effect: Effect, facts: Mapping[str, str | float]) -> Effect:
    """The effect in those runs only whose set-up states some facts.

    Args:
        facts: Values by name of the fact, such as {"propeller": "cut"}.
    """
    return replace(effect, apply=partial(_apply_there, inner=effect.apply, facts=dict(facts)))


def _apply_there(
    scene: CopterScene, size: Tensor, run: Run, *, inner: Apply, facts: Mapping[str, str | float]
) -> Any:
    is_there = all(run.setup.get(fact) == value for fact, value in facts.items())
    return inner(scene, size, run) if is_there else scene
