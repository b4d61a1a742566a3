"""Multicopters of any design file: hold a place, follow a figure of eight."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim.copter import (
    FlightEffects,
    FlightState,
    Multicopter,
    fly,
    hover,
    load_design,
)
from diffsim.copter.effects import BodyDrag, MotorLag
from diffsim.core.check import require_number
from diffsim.envs.pictures import copter_picture
from diffsim.envs.task import Entry, Randomization, Task, TaskState

_STATE = ("position", "quaternion", "velocity", "body_rates", "thrusts")
REACH = 3.0  # from the reference [m], beyond which an episode ends
MAX_RATE = 30.0  # of turning, beyond which an episode ends [rad/s]
# flying at all, position error, velocity, turning, thrust away from hover; per step: perfect
# hovering earns 1. Were all rewards negative, ending an episode early by crashing would pay.
WEIGHTS = {
    "alive": 1.0,
    "position": 1.0 / REACH,
    "velocity": 0.02,
    "turning": 0.003,
    "effort": 0.003,
}


class CopterHover(Task):
    """Fly to the origin and stay there, from a place, attitude and velocity nearby.

    Args:
        design: Name of a shipped design, a design file, or a vehicle.
        dt: Control period [s].
        seconds: Length of an episode [s].
        start_spread: Standard deviations of the start, in m, m/s, and tenths of a radian [-].
        motor_time_constant: Lag of the thrust behind its command [s].
        drag: Linear drag of the body [N s/m].
        wind_speed: Standard deviation of each horizontal component of the episode's wind [m/s].
        action_delay, randomization: The same as for every task; ``thrust`` may be randomized.
    """

    name = "CopterHover"
    randomizable = ("thrust",)

    def __init__(
        self,
        design: str | Path | Multicopter = "quadcopter",
        *,
        dt: float = 0.02,
        seconds: float = 4.0,
        start_spread: float = 0.5,
        motor_time_constant: float = 0.03,
        drag: float = 0.1,
        wind_speed: float = 0.0,
        action_delay: int = 0,
        randomization: Randomization | None = None,
    ):
        super().__init__(action_delay=action_delay, randomization=randomization)
        if not isinstance(design, Multicopter):
            design = load_design(design).multicopter()
        self.vehicle = design
        self.dt = require_number("dt", dt, above=0.0)
        self.max_steps = round(require_number("seconds", seconds, at_least=dt) / dt)
        self.start_spread = require_number("start_spread", start_spread, at_least=0.0)
        self.wind_speed = require_number("wind_speed", wind_speed, at_least=0.0)
        n = design.num_rotors
        trim = hover(design, on_infeasible="raise")
        self.trim = trim.thrusts.detach()
        self.level = torch.tensor([*trim.attitude.tolist(), 0.0], dtype=torch.float64)
        # as far up as down, so that actions act linearly
        self.span = torch.minimum(self.trim, design.max_thrusts - self.trim).detach()
        self._lag = MotorLag(
            time_constants=torch.full(
                (n,), require_number("motor_time_constant", motor_time_constant, above=0.0)
            ).double()
        )
        linear = torch.full((3,), require_number("drag", drag, at_least=0.0), dtype=torch.float64)
        self._drag = BodyDrag(linear=linear, quadratic=torch.zeros(3, dtype=torch.float64))
        self.actions = tuple(Entry(f"thrust of rotor {i}", -1.0, 1.0) for i in range(n))
        self.observations = tuple(self._entries())

    def rest(self, batch: int, rng: np.random.Generator) -> TaskState:
        """Near the reference, motors at hover thrust."""
        s = self.start_spread

        def normal(width: int, sd: float) -> Tensor:
            return torch.from_numpy(sd * rng.standard_normal((batch, width)))

        position, velocity = normal(3, s), normal(3, 0.5 * s)
        state = FlightState.at_rest(position, self.level + normal(3, 0.1 * s))
        wind = normal(3, self.wind_speed) * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
        phase = torch.from_numpy(rng.uniform(0.0, 2.0 * math.pi, batch))
        place, along = self._reference(torch.zeros_like(phase), phase)
        return {
            "position": position + place,
            "quaternion": state.quaternion,
            "velocity": velocity + along,
            "body_rates": normal(3, 0.2 * s),
            "thrusts": self.trim.expand(batch, -1).clone(),
            "wind": wind,
            "phase": phase,
        }

    def advance(self, state: TaskState, action: Tensor) -> TaskState:
        """One control period of flight."""
        thrust = (self.trim + self.span * action) * self.factor(state, "thrust")[:, None]
        effects = FlightEffects(
            motor_lag=self._lag, body_drag=self._drag, wind=state["wind"][:, None]
        )
        start = FlightState(*(state[k] for k in _STATE))
        end = fly(self.vehicle, start, thrust[:, None], dt=self.dt, effects=effects).state
        after = {k: getattr(end, k)[:, -1] for k in _STATE}
        return after | {"wind": state["wind"], "phase": state["phase"]}

    def observe(self, state: TaskState) -> Tensor:
        """Errors and velocities in the body frame, attitude, turning, thrust, what comes next."""
        now = self._flight(state)
        rotation = now.rotation
        place, velocity = self._reference_at(state, 0.0)
        parts = [
            _in_body(rotation, state["position"] - place),
            _in_body(rotation, state["velocity"] - velocity),
            rotation.flatten(1),
            state["body_rates"],
            state["thrusts"] / self.vehicle.max_thrusts,
            *(_in_body(rotation, self._reference_at(state, t)[0] - place) for t in self.lookahead),
        ]
        return torch.cat(parts, -1)

    lookahead: tuple[float, ...] = ()

    def reward_terms(self, before: TaskState, action: Tensor, after: TaskState) -> TaskState:
        """What flying earns, minus smooth distances; 1 in all at best."""
        place, velocity = self._reference_at(after, 0.0)
        sizes = {
            "position": _smooth_norm(after["position"] - place),
            "velocity": _smooth_norm(after["velocity"] - velocity),
            "turning": _smooth_norm(after["body_rates"]),
            "effort": action.square().mean(-1),
        }
        alive = torch.full_like(sizes["effort"], WEIGHTS["alive"])
        return {"alive": alive} | {name: -WEIGHTS[name] * size for name, size in sizes.items()}

    def failed(self, state: TaskState) -> Tensor:
        """Too far from the reference, upside down, or turning too fast."""
        place, _ = self._reference_at(state, 0.0)
        far = (state["position"] - place).norm(dim=-1) > REACH
        fast = state["body_rates"].norm(dim=-1) > MAX_RATE
        return far | fast | (self._flight(state).rotation[:, 2, 2] < 0.0)

    def picture(self, state: TaskState, index: int) -> NDArray[np.uint8]:
        """Seen from behind, above and to the side."""
        one = {k: v[index : index + 1] for k, v in state.items()}
        place, _ = self._reference_at(one, 0.0)
        return copter_picture(self.vehicle, self._flight(one), place[0], self._path(one))

    def _reference(self, time: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Place and velocity asked for, (batch, 3)."""
        zero = torch.zeros(len(phase), 3, dtype=torch.float64)
        return zero, zero

    def _reference_at(self, state: TaskState, ahead: float) -> tuple[Tensor, Tensor]:
        return self._reference(state["step"].double() * self.dt + ahead, state["phase"])

    def _path(self, state: TaskState) -> Tensor:
        """Reference over the next seconds, (n, 3), for the picture."""
        return torch.cat([self._reference_at(state, t)[0] for t in np.linspace(0.0, 6.0, 60)])

    @staticmethod
    def _flight(state: TaskState) -> FlightState:
        return FlightState(*(state[k] for k in _STATE))

    def _entries(self) -> list[Entry]:
        inf = math.inf
        out = [Entry(f"position error {a} (body)", -inf, inf, "m") for a in "xyz"]
        out += [Entry(f"velocity error {a} (body)", -inf, inf, "m/s") for a in "xyz"]
        out += [Entry(f"rotation {r}{c}", -1.0 - 1e-6, 1.0 + 1e-6) for r in "xyz" for c in "xyz"]
        out += [Entry(f"body rate {a}", -inf, inf, "rad/s") for a in "xyz"]
        out += [
            Entry(f"thrust {i} over its maximum", -inf, inf) for i in range(self.vehicle.num_rotors)
        ]
        out += [
            Entry(f"reference {a} in {t:g} s (body)", -inf, inf, "m")
            for t in self.lookahead
            for a in "xyz"
        ]
        return out


class CopterTrack(CopterHover):
    """Follow a horizontal figure of eight, entered at a random place.

    Args:
        design: The same as for ``CopterHover``, like all others.
        size: Half length of the figure [m].
        period: Time of one round [s].
        **options: Further options of ``CopterHover``.
    """

    name = "CopterTrack"
    lookahead = (0.1, 0.3)

    def __init__(
        self,
        design: str | Path | Multicopter = "quadcopter",
        *,
        size: float = 1.5,
        period: float = 6.0,
        **options: object,
    ):
        self.size = require_number("size", size, above=0.0)
        self.period = require_number("period", period, above=0.0)
        super().__init__(design, **options)  # type: ignore[arg-type]

    def _reference(self, time: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
        rate = 2.0 * math.pi / self.period
        a = rate * time + phase
        zero = torch.zeros_like(a)
        place = [self.size * torch.sin(a), 0.5 * self.size * torch.sin(2.0 * a), zero]
        slope = [self.size * torch.cos(a), self.size * torch.cos(2.0 * a), zero]
        return torch.stack(place, -1), rate * torch.stack(slope, -1)


def _in_body(rotation: Tensor, vector: Tensor) -> Tensor:
    return (rotation.mT @ vector[..., None])[..., 0]


def _smooth_norm(vector: Tensor, width: float = 0.1) -> Tensor:
    """sqrt(|v|^2 + w^2) - w: quadratic near zero, linear far away."""
    return (vector.square().sum(-1) + width**2).sqrt() - width
