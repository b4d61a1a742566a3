"""Multicopters of any design file: hold a place, follow a figure of eight."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim.copter import (
    Battery,
    Fleet,
    FlightEffects,
    FlightState,
    Multicopter,
    PreparedFlight,
    hover,
    load_design,
    load_vehicle,
    prepare_flight,
)
from diffsim.copter._shipped import beside_or_shipped
from diffsim.copter.vehicle.effects import BodyDrag, MotorLag
from diffsim.core.check import require_number
from diffsim.core.rotation import matrix_from_quaternion
from diffsim.envs.copter_random import (
    PACKED,
    delayed,
    queue_length,
    randomizable,
    sag_of,
    with_factors,
)
from diffsim.envs.kept import ValueOfTensors
from diffsim.envs.pictures import copter_picture
from diffsim.envs.task import Entry, Randomizing, Task, TaskState

if TYPE_CHECKING:
    from diffsim.systems.multicopter.extended import CopterSizes

_ORIGIN = torch.zeros(1, 3, dtype=torch.float64)
# a figure of eight, along x, y and z: amplitudes over its half length, turns per round
_WIDTHS = torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64)
_LOOPS = torch.tensor([1.0, 2.0, 0.0], dtype=torch.float64)
_STATE = ("position", "quaternion", "velocity", "body_rates", "thrusts")
USUAL_LAG = 0.03  # of a thrust behind its command [s]
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
        vehicle: Instead of a design, a vehicle file: YAML of numbers, MJCF or SDF, see
            :func:`diffsim.copter.load_vehicle`; its rotors say how the motors lag.
        dt: Control period [s].
        seconds: Length of an episode [s].
        start_spread: Standard deviations of the start, in m, m/s, and tenths of a radian [-].
        model: ``extended_model.yaml`` of a diagnosis of this design's flights, or the folder that
            holds it: its sizes change the copter. Hover thrust stays that of the design.
        posterior: Whether each episode of each member draws its sizes from the file's posterior,
            by the seed of the start; otherwise they are its values.
        motor_time_constant: Lag of the thrust behind its command [s]; None: the model's or
            the vehicle file's, else 0.03.
        drag: Linear drag of the body [N s/m]; None: 0.1, with a model its own drag alone.
        wind_speed: Standard deviation of each horizontal component of the episode's wind [m/s].
        battery: Sags under the rotors' currents (their models are the design's); None: a voltage
            that stays.
        action_delay, randomization: The same as for every task. ``thrust``, ``mass``, ``inertia``,
            ``drag`` and ``motor_lag`` (its time constant) may be randomized; with a battery also
            ``battery``, its charge at the start. Hover thrust, which an action of zero
            commands, stays that of the nominal vehicle.
    """

    name = "CopterHover"
    length_option = "seconds"
    file_options = ("vehicle", "design", "model")

    @classmethod
    def find_file(cls, option: str, stated: Any, folder: Path, source: str) -> Any:
        """See ``Task``; a design may be a shipped one."""
        if option == "design" and isinstance(stated, str):
            return beside_or_shipped(folder, stated, f"{source}: {option}")
        return super().find_file(option, stated, folder, source)

    def __init__(
        self,
        design: str | Path | Multicopter = "quadcopter",
        *,
        vehicle: str | Path | None = None,
        dt: float = 0.02,
        seconds: float = 4.0,
        start_spread: float = 0.5,
        model: str | Path | None = None,
        posterior: bool = False,
        motor_time_constant: float | None = None,
        drag: float | None = None,
        wind_speed: float = 0.0,
        battery: Battery | None = None,
        action_delay: int = 0,
        randomization: Randomizing = None,
    ):
        self.randomizable = randomizable(battery, randomization)
        super().__init__(action_delay=action_delay, randomization=randomization)
        lags: Tensor | None = None
        if vehicle is not None:
            if not (isinstance(design, str) and design == "quadcopter"):
                raise ValueError(f"give vehicle or design, not both, got {vehicle} and {design}")
            flying = load_vehicle(vehicle)
            design = flying.vehicle
            lags = torch.tensor([r.time_constant for r in flying.rotors], dtype=torch.float64)
        elif not isinstance(design, Multicopter):
            design = load_design(design).multicopter()
        self.vehicle = design
        self.dt = require_number("dt", dt, above=0.0)
        self.max_steps = round(require_number("seconds", seconds, at_least=dt) / dt)
        self.start_spread = require_number("start_spread", start_spread, at_least=0.0)
        self.wind_speed = require_number("wind_speed", wind_speed, at_least=0.0)
        n = design.num_rotors
        self.sizes = None if model is None else _read_sizes(model, n)
        self.posterior = posterior
        if posterior and self.sizes is None:
            raise ValueError("posterior needs a model to draw from; give model=FILE as well")
        drag = self._usual_drag(motor_time_constant, drag)
        self._queue = 0
        if self.sizes is not None and "delay" in self.sizes.names:
            self._queue = queue_length(self.sizes.most_delay, self.dt)
        trim = hover(design, on_infeasible="raise")
        self.trim = trim.thrusts.detach()
        self.level = torch.tensor([*trim.attitude.tolist(), 0.0], dtype=torch.float64)
        # as far up as down, so that actions act linearly
        self.span = torch.minimum(self.trim, design.max_thrusts - self.trim).detach()
        if lags is None or motor_time_constant is not None:
            one = USUAL_LAG if motor_time_constant is None else motor_time_constant
            one = require_number("motor_time_constant", one, above=0.0)
            lags = torch.full((n,), one).double()
        lag = MotorLag(time_constants=lags)
        linear = torch.full((3,), require_number("drag", drag, at_least=0.0), dtype=torch.float64)
        body_drag = BodyDrag(linear=linear, quadratic=torch.zeros(3, dtype=torch.float64))
        self.sag = None if battery is None else sag_of(battery, design)
        self._effects = FlightEffects(motor_lag=lag, body_drag=body_drag, battery=self.sag)
        self._packed: ValueOfTensors[PreparedFlight] | None = None
        self.actions = tuple(Entry(f"thrust of rotor {i}", -1.0, 1.0) for i in range(n))
        self.observations = tuple(self._entries())

    def _usual_drag(self, lag: float | None, drag: float | None) -> float:
        """The drag as stated, as usual, or 0.0 where the model's stands for it."""
        sizes = self.sizes
        if sizes is not None:
            if lag is not None and sizes.has_lag:
                raise ValueError(f"motor_time_constant is that of {sizes.saved.path}; leave it out")
            if drag is not None and sizes.has_drag:
                raise ValueError(f"drag is that of {sizes.saved.path}; leave it out")
        usual = 0.1 if sizes is None else 0.0
        return usual if drag is None else drag

    def rest(self, batch: int, rng: np.random.Generator) -> TaskState:
        """Near the reference, motors at hover thrust."""
        s = self.start_spread

        def normal(width: int, sd: float) -> Tensor:
            return torch.from_numpy(sd * rng.standard_normal((batch, width)))

        position, velocity = normal(3, s), normal(3, 0.5 * s)
        state = FlightState.at_rest(position, self.level + normal(3, 0.1 * s))
        wind = normal(3, self.wind_speed) * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
        phase = torch.from_numpy(rng.uniform(0.0, 2.0 * math.pi, batch))
        begin = {"step": torch.zeros(batch, dtype=torch.int64), "phase": phase}
        place, along = self._reference(begin)
        out = {
            "position": position + place,
            "quaternion": state.quaternion,
            "velocity": velocity + along,
            "body_rates": normal(3, 0.2 * s),
            "thrusts": self.trim.expand(batch, -1).clone(),
            "wind": wind,
            "phase": phase,
        }
        if self.sag is not None:
            out["charge"] = torch.ones(batch, dtype=torch.float64)
        if self._queue:
            out["asked"] = self.trim.expand(batch, self._queue, -1).clone()
        return out

    def start(self, batch: int, rng: np.random.Generator) -> TaskState:
        """See ``Task``; a battery's charge and the sizes of a posterior are drawn here."""
        state = super().start(batch, rng)
        if self.posterior and self.sizes is not None:
            state["random.model"] = self.sizes.draw(batch, rng)
        if "random.battery" in state:
            state["charge"] = state["random.battery"].clone()
        return state

    def advance(self, state: TaskState, action: Tensor) -> TaskState:
        """One control period of flight."""
        thrust = self.trim + self.span * action
        if "random.thrust" in state:
            thrust = thrust * state["random.thrust"][:, None]
        more: TaskState = {}
        if self.sizes is not None:
            sizes = self._sizes_in(state)
            if self._queue:
                steps = self.sizes.delay(sizes) / self.dt
                thrust, more["asked"] = delayed(state["asked"], thrust, steps)
            thrust = thrust * self.sizes.thrust_gains(sizes, self.vehicle.num_rotors)
        end = self._flights(state).step(self._flight(state), thrust, wind=state["wind"])
        after = {k: getattr(end, k) for k in (*_STATE, "charge") if k in state}
        return after | more | {"wind": state["wind"], "phase": state["phase"]}

    def _sizes_in(self, state: TaskState) -> Tensor:
        """Sizes of the model, (batch or 1, num_sizes)."""
        assert self.sizes is not None
        return state["random.model"] if self.posterior else self.sizes.values[None]

    def observe(self, state: TaskState) -> Tensor:
        """Errors and velocities in the body frame, attitude, turning, thrust, what comes next."""
        rotation = matrix_from_quaternion(state["quaternion"])
        place, course = self._reference(state)
        vectors = [state["position"] - place, state["velocity"] - course]
        if self.lookahead:
            coming = self._places(state, self.lookahead) - place[:, None]
            vectors += coming.unbind(1)
        in_body = torch.stack(vectors, 1) @ rotation
        parts = [
            in_body[:, :2].flatten(1),
            rotation.flatten(1),
            state["body_rates"],
            state["thrusts"] / self.vehicle.max_thrusts,
            in_body[:, 2:].flatten(1),
        ]
        return torch.cat(parts, -1)

    lookahead: tuple[float, ...] = ()

    def reward_terms(self, before: TaskState, action: Tensor, after: TaskState) -> TaskState:
        """What flying earns, minus smooth distances; 1 in all at best."""
        place, course = self._reference(after)
        errors = [after["position"] - place, after["velocity"] - course, after["body_rates"]]
        distances = _smooth_norm(torch.stack(errors)).unbind()
        sizes = dict(zip(("position", "velocity", "turning"), distances, strict=True))
        sizes["effort"] = action.square().mean(-1)
        alive = torch.full_like(sizes["effort"], WEIGHTS["alive"])
        return {"alive": alive} | {name: -WEIGHTS[name] * size for name, size in sizes.items()}

    def failed(self, state: TaskState) -> Tensor:
        """Too far from the reference, upside down, or turning too fast."""
        away = state["position"] - self._reference(state)[0]
        far = torch.linalg.vector_norm(away, dim=-1) > REACH
        fast = torch.linalg.vector_norm(state["body_rates"], dim=-1) > MAX_RATE
        # the last entry of the rotation is 1 - 2 (x^2 + y^2)
        upside_down = state["quaternion"][:, 1:3].square().sum(-1) > 0.5
        return far | fast | upside_down

    def picture(self, state: TaskState, index: int) -> NDArray[np.uint8]:
        """Seen from behind, above and to the side."""
        one = {k: v[index : index + 1] for k, v in state.items()}
        place = self._reference(one)[0][0]
        path = self._places(one, np.linspace(0.0, 6.0, 60).tolist())[0]
        return copter_picture(self.vehicle, self._flight(one), place, path)

    def _flights(self, state: TaskState) -> PreparedFlight:
        """What flies the vehicles; packed anew where a tensor of it changed or carries gradients.

        Random factors stay the same tensors throughout an episode.
        """
        sources = self.vehicle, self._effects.motor_lag, self._effects.body_drag
        tensors = [t for s in sources for t in vars(s).values() if isinstance(t, Tensor)]
        factors = {name: state[f"random.{name}"] for name in PACKED if f"random.{name}" in state}
        tensors += factors.values()
        if self.sizes is not None:
            tensors.append(state["random.model"] if self.posterior else self.sizes.values)
        kept = self._packed
        if kept is not None and kept.is_of(tensors) and kept.value.dt == self.dt:
            return kept.value
        nominal: Multicopter | Fleet = self.vehicle
        effects = self._effects
        if self.sizes is not None:
            nominal, effects = self.sizes.vehicles(self.vehicle, effects, self._sizes_in(state))
        vehicles, effects = with_factors(nominal, effects, factors)
        flights = prepare_flight(vehicles, dt=self.dt, effects=effects)
        if not any(t.requires_grad for t in tensors):
            self._packed = ValueOfTensors(flights, tensors)
        return flights

    def _reference(self, state: TaskState) -> tuple[Tensor, Tensor]:
        """Place and velocity asked for now, (batch or 1, 3)."""
        return _ORIGIN, _ORIGIN

    def _places(self, state: TaskState, ahead: Sequence[float]) -> Tensor:
        """Places asked for some seconds ahead, (batch or 1, len(ahead), 3)."""
        return _ORIGIN.expand(1, len(ahead), 3)

    @staticmethod
    def _flight(state: TaskState) -> FlightState:
        return FlightState(**{k: state[k] for k in (*_STATE, "charge") if k in state})

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
        self._asked: ValueOfTensors[tuple[Tensor, Tensor]] | None = None
        super().__init__(design, **options)  # type: ignore[arg-type]

    def _reference(self, state: TaskState) -> tuple[Tensor, Tensor]:
        # reward, failure and observation of one state ask for the same
        of = [state["step"], state["phase"]]
        if self._asked is not None and self._asked.is_of(of):
            return self._asked.value
        turns = self._turns(state, torch.zeros(1, dtype=torch.float64))[:, 0]
        slope = self.size * _WIDTHS * _LOOPS * torch.cos(turns)
        asked = self.size * _WIDTHS * torch.sin(turns), 2.0 * math.pi / self.period * slope
        if not any(t.requires_grad for t in of):
            self._asked = ValueOfTensors(asked, of)
        return asked

    def _places(self, state: TaskState, ahead: Sequence[float]) -> Tensor:
        times = torch.tensor(ahead, dtype=torch.float64)
        return self.size * _WIDTHS * torch.sin(self._turns(state, times))

    def _turns(self, state: TaskState, ahead: Tensor) -> Tensor:
        """Angle of each coordinate along the figure, (batch, len(ahead), 3) [rad]."""
        now = (state["step"].double() * self.dt)[:, None] + ahead
        along = 2.0 * math.pi / self.period * now + state["phase"][:, None]
        return along[..., None] * _LOOPS


def _read_sizes(model: str | Path, num_rotors: int) -> CopterSizes:
    # with it come all systems of the diagnosis, half a second
    from diffsim.systems.multicopter.extended import CopterSizes

    return CopterSizes.read(model, num_rotors)


def _smooth_norm(vector: Tensor) -> Tensor:
    """sqrt(|v|^2 + w^2) - w with w = 0.1: quadratic near zero, linear far away."""
    return (vector.square().sum(-1) + 0.1**2).sqrt() - 0.1
