"""Candidate causes of a described multicopter: those that its recording can show, in its frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

from torch import Tensor

from diffsim.causes.commands import HELD_DELAY, HELD_LAG, in_words, quantization
from diffsim.copter import GRAVITY
from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.multicopter import effects as causes
from diffsim.systems.multicopter import sensors as seen
from diffsim.systems.multicopter import single_rotors as single
from diffsim.systems.multicopter.frames import Frames
from diffsim.systems.multicopter.loads import EXTRA_MASS, GUST, SLUNG_LOAD
from diffsim.systems.multicopter.moments import (
    CLIMB_MOMENT,
    FLOW_MOMENT,
    RATE_DAMPING,
    SPIN_UP,
)
from diffsim.systems.multicopter.rotors import ROTOR_SPEED_DRAG, SPEED_LAG
from diffsim.systems.multicopter.scene import CopterScene, vector

_CAMERAS = {"position", "velocity", "attitude", "quaternion"}
_MASS, _ARM = 1.0, 0.25  # of the vehicle that typical sizes are written for [kg], [m]


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


def candidate_causes(of: Vehicle) -> tuple[Effect, ...]:
    """All candidates, their usual sizes by the mass and size of the vehicle."""
    mass, arm = of.mass / _MASS, of.arm / _ARM
    in_world = partial(_turned, turn=of.frames.in_world)
    in_body = partial(_turned, turn=of.frames.in_body)
    out = [
        causes.ROTOR_DRAG,
        _scaled(causes.BODY_DRAG, mass),
        _scaled(causes.PARASITIC_DRAG, mass),
        _scaled(in_world(_named(causes.WIND, of.frames)), mass),
        in_body(causes.BODY_TILT),
        causes.INFLOW,
        causes.WAKE,
        causes.THRUST_CURVATURE,
        *_of_vehicle(of, mass, arm, in_body),
        *_of_sensors(of, arm, in_body),
        *(in_body(e) if len(e.components) > 1 else e for e in single.of_each_rotor(of.num_rotors)),
    ]
    if of.has_thrust:
        out.insert(0, thrust_steps(of.mass, of.num_rotors))
    if not of.has_lag:
        out.append(SPEED_LAG if of.lags_speed else HELD_LAG)
    if not of.has_clock:
        out.append(HELD_DELAY)
    return tuple(out)


def thrust_steps(mass: float, num_rotors: int) -> Effect:
    """Thrust that is commanded in whole steps, of commands up to half more than hover needs.

    Args:
        mass: Of the vehicle [kg].
        num_rotors: Number of rotors.
    """
    reach = 1.5 * mass * GRAVITY / num_rotors
    return in_words(quantization(reach, held=True), "N")


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


def _of_vehicle(
    of: Vehicle, mass: float, arm: float, in_body: Callable[[Effect], Effect]
) -> Iterator[Effect]:
    yield _scaled(SLUNG_LOAD, mass)
    yield _scaled(GUST, mass)
    if not of.has_mass:
        yield _scaled(EXTRA_MASS, mass)
    if of.has_speed:
        yield _scaled(ROTOR_SPEED_DRAG, mass)
    if of.has_speed and of.num_rotors >= 4:  # small torques show where speeds were measured
        yield _scaled(FLOW_MOMENT, mass * arm)
        yield _scaled(CLIMB_MOMENT, mass * arm)
        yield RATE_DAMPING
        yield _scaled(SPIN_UP, mass * arm**2)
    if not of.has_center:
        yield _scaled(in_body(causes.CENTER_OF_MASS), arm)
    if of.num_rotors >= 4:
        yield replace(_scaled(causes.GYROSCOPIC, mass * arm**2), needs=_nothing)
    if of.battery is not None:
        yield causes.voltage_exponent(of.battery)
    elif not of.has_speed:  # a speed that was measured has fallen already
        yield causes.BATTERY_SAG
    if of.has_radius and "position" in of.sensors:
        yield causes.GROUND_EFFECT


def _of_sensors(of: Vehicle, arm: float, in_body: Callable[[Effect], Effect]) -> Iterator[Effect]:
    force = {"accelerometer", "specific_force_in_world", "acceleration"} & set(of.sensors)
    if "position" in of.sensors:
        yield _scaled(in_body(seen.MARKER_PLACEMENT), arm)
        yield seen.POSITION_SCALE
        if "velocity" in of.sensors:  # two sensors whose scales may disagree
            yield seen.GROUND_SCALE
            if of.has_estimator:
                yield seen.BLIND_ESTIMATOR
    if "body_rates" in of.sensors:
        yield seen.GYRO_OFFSET
    if "body_rates" in of.sensors or force:
        yield in_body(seen.IMU_TILT)
    has_unit = "body_rates" in of.sensors or force
    if has_unit and _CAMERAS & set(of.sensors) and not of.states_sensors:
        yield seen.CAMERA_DELAY
    if force:
        yield seen.ACCELEROMETER_SCALE


def _nothing(study: object) -> str | None:
    return None


def _scaled(effect: Effect, factor: float) -> Effect:
    return replace(effect, typical=effect.typical * factor)


def _named(effect: Effect, frames: Frames) -> Effect:
    """Components by what a reader of the recording calls them."""
    if frames.world == "NED":
        return effect
    return replace(
        effect, components=("x", "y"), form="Constant force in the world, along x and y."
    )


def _turned(effect: Effect, turn: Callable[[Tensor], Tensor]) -> Effect:
    """The effect with components along the axes of the recording."""
    return replace(effect, apply=partial(_apply_turned, inner=effect.apply, turn=turn))


def _apply_turned(
    scene: CopterScene,
    size: Tensor,
    run: Run,
    *,
    inner: Callable[[CopterScene, Tensor, Run], CopterScene],
    turn: Callable[[Tensor], Tensor],
) -> CopterScene:
    return inner(scene, turn(vector(size)), run)
