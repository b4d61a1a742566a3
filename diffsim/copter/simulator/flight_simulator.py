"""Flights in closed loop: sensors, controller, pulses, motors, battery, ground (thesis 3.5)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from diffsim.copter.design.design import Design
from diffsim.copter.dynamics.flight import Flight, FlightError, fly
from diffsim.copter.dynamics.flight_state import FlightState
from diffsim.copter.simulator.controllers import (
    Controller,
    LqrController,
    PidFlightController,
    Pilot,
    Setpoint,
    flyable_hover,
)
from diffsim.copter.simulator.log import FlightLog, FlightSample
from diffsim.copter.simulator.outputs import SAFE_PWM, MotorOutputs, Outputs, flight_rotors
from diffsim.copter.simulator.pacing import Pacer
from diffsim.copter.simulator.payload import require_payload, with_payload
from diffsim.copter.simulator.sensing import FlightSensors, SensorStream, StateEstimator
from diffsim.copter.vehicle.battery import Battery
from diffsim.copter.vehicle.effects import FlightEffects
from diffsim.copter.vehicle.multicopter import Multicopter
from diffsim.copter.vehicle.rotor import RotorModel, motor_lag
from diffsim.copter.vehicle.vehicle_record import FlyingVehicle
from diffsim.core.check import require_choice, require_number
from diffsim.core.checked import checked

CONTROLLERS = ("lqr", "pid")
Observer = Callable[[FlightSample], None]


class FlightSimulator:
    """One multicopter on the ground, ready to fly.

    Every control period: sensors are read, the state estimated, the controller asks for thrusts,
    these become pulse widths by the inverse of the bench's map at the voltage measured (thesis
    3.3.1), clamped; the motors lag behind; the rigid body moves (``fly``); the battery delivers the
    motors' electrical power. Sag thus shows in the pulses, and in thrust once they are clamped.

    Args:
        design: A composed design, a vehicle as ``load_vehicle`` gives it, or bare mass properties.
        controller: "lqr", "pid", or one that may believe in another vehicle.
        payload: Carried below the center of mass, known to the controllers named above [kg].
        rotors: One model per rotor; by default those that the vehicle names.
        battery: By default that of the vehicle file, else three cells of 2200 mA h; full.
        effects: Drags, wind, ground effect, interference; not the battery. A motor lag here wins
            over that of the rotors.
        sensors: None: the controller sees the true state.
        pwm_max: No pulse is longer [us]; 1800 is the thesis's, 2000 the motors'.
        rate: Control rate [Hz].
        substeps: Integration steps per control period.
        idle_power: Electric power of everything on board but the motors [W].
        seed: Seed of the noise: equal seeds, equal flights.
        flies: How the vehicle flies a step: ``fly``, or that of a diagnosed copter
            (``ExtendedCopter.stepwise``), of which the controllers named above know nothing.

    Attributes:
        log: Log of the flight so far.

    Raises:
        PayloadError: the vehicle does not hold the load up; names the limit.
        HoverError, RiccatiError: it cannot hover, or cannot be controlled there.
        TypeError, ValueError: bad arguments.
    """

    @checked
    def __init__(
        self,
        design: Design | FlyingVehicle | Multicopter,
        *,
        controller: str | Controller = "lqr",
        payload: float = 0.0,
        rotors: Sequence[RotorModel] | None = None,
        battery: Battery | None = None,
        effects: FlightEffects | None = None,
        sensors: FlightSensors | None = FlightSensors(),  # noqa: B008 frozen
        pwm_max: float = SAFE_PWM,
        rate: float = 100.0,
        substeps: int = 2,
        idle_power: float = 3.0,
        seed: int = 0,
        flies: Callable[..., Flight] = fly,
    ):
        self._flies = flies
        vehicle, known, pack = _unpack_vehicle(design)
        rotors = known or flight_rotors(vehicle) if rotors is None else tuple(rotors)
        battery = pack if battery is None else battery
        self.dt = 1.0 / require_number("rate", rate, above=0.0)
        self._substeps, self._step = substeps, 0
        self._idle_power = require_number("idle_power", idle_power, at_least=0.0)
        self.battery = Battery.lipo(cells=3, capacity_mah=2200.0) if battery is None else battery
        self._outputs = MotorOutputs(rotors, vehicle.max_thrusts, pwm_max=pwm_max)
        flyable_hover(vehicle)
        require_payload(vehicle, payload, self._outputs, self.battery)
        self.vehicle = with_payload(vehicle, payload)
        self.controller = self._make_controller(controller)
        self._effects = _with_lag(effects, rotors)
        self._ground = Ground()
        self._stream = None if sensors is None else SensorStream(sensors, seed)
        start = Ground.start()
        self._estimator = None if sensors is None else StateEstimator(sensors, self.dt, start)
        self.state = replace(
            start,
            thrusts=torch.zeros(1, vehicle.num_rotors, dtype=torch.float64),
            charge=torch.ones(1, dtype=torch.float64),
        )
        self._acceleration = np.zeros(3)
        self._voltage, self._current = self._battery_at(self.state)
        self.log = FlightLog(
            {
                "design": "multicopter" if isinstance(design, Multicopter) else design.name,
                "controller": self.controller.name,
                "mass_kg": float(self.vehicle.mass),
                "payload_kg": payload,
                "rotors": [r.name for r in rotors],
                "pwm_max_us": pwm_max,
                "rate_Hz": rate,
                "sensors": sensors is not None,
                "effects": [name for name, _ in self._effects.present()],
                "seed": seed,
            }
        )

    @property
    def time(self) -> float:
        """Time of the state [s]."""
        return self._step * self.dt

    @torch.no_grad()
    def step(self, target: Setpoint, *, lag: float = 0.0) -> FlightSample:
        """One control period; the sample is appended to ``log``.

        Raises:
            FlightError: a crash, an empty battery, a state that is no longer finite.
        """
        estimate = self._estimate()
        out = self._command(estimate, target)
        sample = self._sample(estimate, target, out, lag)
        self.log.samples.append(sample)
        self._move(out.thrusts)
        return sample

    @checked
    def run(
        self,
        pilot: Pilot,
        *,
        seconds: float | None = None,
        pacer: Pacer | None = None,
        observers: Sequence[Observer] = (),
    ) -> FlightLog:
        """Fly until the pilot is done, or for that long.

        Args:
            pilot: Mission or sticks.
            seconds: Duration [s], instead of the pilot's; needed where that is None and nobody
                presses Ctrl-C, which ends the flight and keeps its log.
            pacer: Keeps to the wall clock; by default as fast as possible.
            observers: Functions called with every sample, such as a viewer.

        Returns:
            ``log``.

        Raises:
            FlightError: see ``step``; ``log`` holds the flight up to there.
        """
        duration = (
            pilot.duration if seconds is None else require_number("seconds", seconds, above=0.0)
        )
        pacer = Pacer(0.0) if pacer is None else pacer
        end = None if duration is None else self._step + round(duration / self.dt)
        try:
            while end is None or self._step <= end:
                lag = pacer.wait(self.time)
                sample = self.step(pilot.setpoint(self.time), lag=lag)
                for observe in observers:
                    observe(sample)
            self.log.outcome = "done"
        except KeyboardInterrupt:
            self.log.outcome = "interrupted"
        except FlightError as error:
            self.log.outcome = str(error)
            raise
        return self.log

    def _make_controller(self, controller: str | Controller) -> Controller:
        if not isinstance(controller, str):
            return controller
        require_choice("controller", controller, CONTROLLERS)
        return (LqrController if controller == "lqr" else PidFlightController)(self.vehicle)

    def _estimate(self) -> FlightState:
        if self._stream is None or self._estimator is None:
            return self.state
        return self._estimator.update(self._stream.read(self.state, self._acceleration))

    def _command(self, estimate: FlightState, target: Setpoint) -> Outputs:
        if not target.motors_on:
            self.controller.reset()
            return self._outputs.standing()
        wanted = self.controller.thrusts(estimate, target, self.dt)
        return self._outputs.command(wanted, self._voltage)

    def _move(self, thrusts: Tensor) -> None:
        before = self.state
        effects = _at_step(self._effects, self._step)
        flight = self._flies(
            self.vehicle,
            before,
            thrusts[None, None],
            dt=self.dt,
            effects=effects,
            substeps=self._substeps,
        )
        after = FlightState(**{k: v[:, -1] for k, v in vars(flight.state).items()})
        assert before.charge is not None
        charge = before.charge - self._current * self.dt / self.battery.capacity
        after = self._ground.hold(replace(after, charge=charge), self._step)
        self._acceleration = (after.velocity - before.velocity)[0].numpy() / self.dt
        self.state = after
        self._step += 1
        if not float(charge) > 0.0:
            raise FlightError(
                f"the battery is empty after {self.time:.1f} s; land earlier, or give a larger one",
                vehicle=0,
                step=self._step,
            )
        self._voltage, self._current = self._battery_at(after)

    def _battery_at(self, state: FlightState) -> tuple[Tensor, Tensor]:
        """Voltage and current, () [V], [A]; the motors' power is that of their thrust."""
        assert state.thrusts is not None and state.charge is not None
        power = self._outputs.power(state.thrusts[0]) + self._idle_power
        current = self.battery.current_for_power(state.charge[0], power)
        return self.battery.voltage(state.charge[0], current), current

    def _sample(
        self, estimate: FlightState, target: Setpoint, out: Outputs, lag: float
    ) -> FlightSample:
        state = self.state
        assert state.thrusts is not None and state.charge is not None
        place = np.array(target.position, dtype=np.float64)
        if target.hold_attitude:  # nowhere else was asked for
            place[:2] = state.position[0, :2].numpy()
        return FlightSample(
            time=self.time,
            position=state.position[0].numpy(),
            velocity=state.velocity[0].numpy(),
            quaternion=state.quaternion[0].numpy(),
            rpy=state.rpy[0].numpy(),
            target=place,
            target_yaw=target.yaw,
            estimate=estimate.position[0].numpy(),
            pwm=out.pwm.numpy(),
            thrusts=state.thrusts[0].numpy(),
            saturated=out.saturated.numpy(),
            motors_on=target.motors_on,
            voltage=float(self._voltage),
            current=float(self._current),
            charge=float(state.charge[0]),
            lag=lag,
        )


def _unpack_vehicle(
    design: Design | FlyingVehicle | Multicopter,
) -> tuple[Multicopter, tuple[RotorModel, ...], Battery | None]:
    """Vehicle without gradients, and the rotors and the battery that come with it."""
    if isinstance(design, FlyingVehicle):
        return design.vehicle.detach(), design.rotors, design.battery
    vehicle = design if isinstance(design, Multicopter) else design.multicopter()
    return vehicle.detach(), (), None


def _with_lag(effects: FlightEffects | None, rotors: Sequence[RotorModel]) -> FlightEffects:
    effects = FlightEffects() if effects is None else effects
    if effects.battery is not None:
        raise ValueError(
            "effects.battery must be None: the simulator has a battery of its own; give it as "
            "battery=..."
        )
    if effects.motor_lag is not None or any(r.time_constant is None for r in rotors):
        return effects
    return replace(effects, motor_lag=motor_lag(rotors))


def _at_step(effects: FlightEffects, step: int) -> FlightEffects:
    """Effects of one step: a row of a gust's series, whose last row stays."""
    wind = effects.wind
    if wind is None or wind.dim() == 1:
        return effects
    if wind.dim() == 3:
        raise ValueError("effects.wind must be (3,) or (steps, 3) for one vehicle")
    return replace(effects, wind=wind[min(step, len(wind) - 1)])


class Ground:
    """Holds a vehicle that touches it: at rest, level, its heading kept.

    No bouncing, sliding or tipping; a harder touch than the limits is a crash.

    Args:
        max_speed: Largest speed of touching down [m/s].
        max_tilt: At touch-down [rad].
    """

    def __init__(self, *, max_speed: float = 1.5, max_tilt: float = math.radians(40.0)):
        self.max_speed = require_number("max_speed", max_speed, above=0.0)
        self.max_tilt = require_number("max_tilt", max_tilt, above=0.0)

    def hold(self, state: FlightState, step: int) -> FlightState:
        """The state, or that of standing where it is at the ground or below.

        Args:
            state: Leading axis (1,).
            step: Control step, for the error message.

        Raises:
            FlightError: a crash.
        """
        if float(state.position[0, 2]) < 0.0:
            return state
        speed = float(state.velocity[0].norm())
        tilt = math.acos(max(-1.0, min(1.0, float(state.rotation[0, 2, 2]))))
        if speed > self.max_speed or tilt > self.max_tilt:
            raise FlightError(
                f"crashed in step {step}: hit the ground at {speed:.2f} m/s and "
                f"{math.degrees(tilt):.0f} degrees of tilt, allowed {self.max_speed:g} m/s and "
                f"{math.degrees(self.max_tilt):.0f} degrees; fly slower, lighter or higher",
                vehicle=0,
                step=step,
            )
        position = state.position * state.position.new_tensor([1.0, 1.0, 0.0])
        rpy = state.rpy * state.position.new_tensor([0.0, 0.0, 1.0])
        return replace(
            FlightState.at_rest(position, rpy), thrusts=state.thrusts, charge=state.charge
        )

    @staticmethod
    def start() -> FlightState:
        """Standing at the origin, heading north, leading axis (1,)."""
        return FlightState.at_rest(torch.zeros(1, 3, dtype=torch.float64))
