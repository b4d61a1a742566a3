"""The starfish of the sim-to-real loop, steered by one servo in closed loop: a task to learn.

The body is the quarter of :class:`labs.loop.Starfish`. Between what a controller asks for
and what the tendons do lies a servo; what is known of it decides what a controller learns.
:class:`Steering` takes a trained controller to the virtual laboratory.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from diffsim import soft
from diffsim.envs.task import Entry, Task, TaskState
from diffsim.learn.setup import Setup
from diffsim.soft.hydrodynamics import DRAG_COEFFICIENTS, THRUST_COEFFICIENTS
from labs.loop import Limits, Starfish
from labs.loop.body import TENDON
from labs.loop.command import RATE_HZ
from labs.loop.model import water_of

DT = 1.0 / RATE_HZ  # of simulation and camera [s]
HOLD = 6  # samples that an action is held: quicker ones shake the robot, as no servo can
CONTROL_S = HOLD * DT  # a control step [s]
STROKE_S = 0.55  # the real robot opens and closes in 0.547 s
CLOCK_HZ = (0.5 / STROKE_S, 1.0 / STROKE_S)  # a stroke and half of it, as diffsim.learn.recipes
SETTLE_S = 2.0 * STROKE_S  # rewards count from here on, as the laboratory's speed does
# what is known of body and water before anything is recorded, by the names of ``table_5_1``
DATA_SHEET: Mapping[str, float] = {
    "youngs_modulus": 5e5,  # [Pa]
    "axial_stiffness": 600.0,  # of a tendon [N]
    **{f"drag_{i}": c for i, c in enumerate(DRAG_COEFFICIENTS, 1)},
    **{f"thrust_{i}": c for i, c in enumerate(THRUST_COEFFICIENTS, 1)},
}
RAIL_FRICTION_N, CREEP_M_S = 2e-3, 1e-3  # of the whole robot; below this speed it is viscous
UNIT_M_S = 0.01  # of the reward
FAST_M_S = 0.1  # of a leg; scales what is sensed


@dataclass(frozen=True, kw_only=True)
class Servo:
    """What is known of the servo."""

    lag_s: float = 0.0  # time constant of its lag [s]; 0: it follows at once
    rate_m_s: float | None = None  # its greatest speed [m/s]; None: there is no limit
    slack_m: float = 0.0  # pull that moves nothing [m]

    def dynamics(self) -> soft.ActuatorDynamics:
        """Lag and limited speed."""
        return soft.ActuatorDynamics(self.lag_s or None, self.rate_m_s)

    def pull(self, arm: Tensor) -> Tensor:
        """What the tendons are shortened by where the servo's arm is [m]."""
        return (arm - self.slack_m).clamp(min=0.0)

    def pulls(self, command: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the tendons are shortened by under a command at ``RATE_HZ``, (num_samples,) [m].

        The arm begins at the command's first value.
        """
        dynamics, out = self.dynamics(), []
        arm = torch.full((1, 1), float(command[0]), dtype=torch.float64)
        for asked in torch.from_numpy(np.asarray(command, dtype=float)):
            arm, _ = dynamics(asked[None, None], dynamics.initial_state(arm), DT)
            out.append(float(self.pull(arm)))
        return np.array(out)


class TendonSwim(Task):
    """Swim along -x on the rail; the action is the contraction of all four tendons.

    An action asks for a contraction, to which the command runs as fast as it may, and holds for a
    tenth of a second. Observed: velocities of the tips and of the legs' middles over that time, as
    four markers show them; the last command; a clock. The reward is the speed of the center of mass
    [cm/s] from the second stroke on: one push from rest glides far, but it is no swimming.

    Args:
        servo: What lies between command and tendon.
        seconds: Length of an episode [s].
        limits: What may be commanded.
        body: Parameters of body and water, named as ``labs.loop.model.table_5_1`` has them;
            None: ``DATA_SHEET``.
    """

    name = "TendonSwim"

    def __init__(
        self,
        servo: Servo,
        seconds: float = 4.0,
        limits: Limits | None = None,
        body: Mapping[str, float] | None = None,
    ):
        super().__init__()
        known = dict(DATA_SHEET if body is None else body)
        self.servo, self.limits = servo, limits or Limits()
        self.dynamics = servo.dynamics()
        self.dt, self.max_steps = CONTROL_S, round(seconds / CONTROL_S)
        self.model = Starfish()
        self.body = self.model.quarter.body
        self.physics = self.body.physics(
            youngs_modulus=torch.tensor(known["youngs_modulus"]).double(),
            # half a tendon in a quarter of the body
            fiber_stiffness=torch.full((2,), 0.5 * known["axial_stiffness"]).double(),
            rayleigh_beta=torch.tensor(self.model.rayleigh_beta).double(),
            added_mass=1000.0 * self.model.added_mass * self.body.nodal_volume,
        )
        drag, thrust = (
            torch.tensor([known[f"{name}_{i}"] for i in range(1, 5)]).double()
            for name in ("drag", "thrust")
        )
        self.water = water_of(self.body.mesh, drag, thrust)
        self.actions = (Entry("contraction", -1.0, 1.0),)
        sensed = [f"{place} {way}" for place in ("tip", "middle") for way in ("x", "closing")]
        fast = [Entry(f"velocity of {s}", -np.inf, np.inf, "0.1 m/s") for s in sensed]
        clock = [Entry(f"{f:g} Hz {hand}", -1.0, 1.0) for f in CLOCK_HZ for hand in ("sine", "cos")]
        self.observations = (*fast, Entry("last command", -1.0, 1.0), *clock)
        self.clock_inputs = tuple(range(len(fast) + 1, len(self.observations)))

    def rest(self, batch: int, rng: np.random.Generator) -> TaskState:
        """At rest, the tendons at their full length."""
        x = self.body.x_rest.expand(batch, -1, -1).clone()
        places = self.model.observe(x)[:, :-1]
        none = torch.zeros(batch, 1, dtype=torch.float64)
        return {
            "x": x,
            "v": torch.zeros_like(x),
            "places": places,
            "places_before": places,
            "asked": none,
            "arm": none,
        }

    def advance(self, state: TaskState, action: Tensor) -> TaskState:
        """One control step."""
        asked, arm, now = state["asked"], state["arm"], soft.State(state["x"], state["v"])
        for _ in range(HOLD):
            asked = self.ask(action, asked)
            now, arm = self.pulled(now, arm, asked)
        return {
            "x": now.x,
            "v": now.v,
            "places": self.model.observe(now.x)[:, :-1],
            "places_before": state["places"],
            "asked": asked,
            "arm": arm,
        }

    def pulled(self, now: soft.State, arm: Tensor, asked: Tensor) -> tuple[soft.State, Tensor]:
        """Body and servo arm a sample later.

        Args:
            now: State of the body.
            arm: Where the servo's arm is, (batch, 1) [m].
            asked: The command, (batch, 1) [m].
        """
        arm, _ = self.dynamics(asked, self.dynamics.initial_state(arm), DT)
        pull = self.servo.pull(arm)
        after = soft.step(
            self.body,
            soft.State(now.x, now.v),
            external_force=self.water(now.x, now.v) + self.on_rail(now.v),
            activation=(1.0 - pull / TENDON).expand(-1, 2),
            physics=self.physics,
        )
        return after, arm

    def on_rail(self, v: Tensor) -> Tensor:
        """Dry friction of the rail on a quarter of the robot, shape of v [N].

        Without it one push glides through a whole episode, and that is what is learned.
        """
        share = self.model.quarter.rail[:, None]
        speed = (share * v[..., :1]).sum(-2, keepdim=True)
        along = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
        return -0.25 * RAIL_FRICTION_N * torch.tanh(speed / CREEP_M_S) * share * along

    def ask(self, action: Tensor, last: Tensor) -> Tensor:
        """Contraction [m] of an action a sample later, within the limits, after the last one."""
        most = self.limits.rate_m_s * DT
        wish = 0.5 * (1.0 + action) * self.limits.contraction_m
        return last + (wish - last).clamp(-most, most)

    def observe(self, state: TaskState) -> Tensor:
        """See the class."""
        return self.sense(
            state["places"], state["places_before"], state["asked"], state["step"] * self.dt
        )

    def sense(self, places: Tensor, before: Tensor, asked: Tensor, time: Tensor) -> Tensor:
        """Observations (batch, n) of markers' places (batch, 8) [m].

        Args:
            places, before: As ``labs.loop.model.CHANNELS``, a control step apart.
            asked: Last command, (batch, 1) [m].
            time: Since the start, (batch,) [s].
        """
        fast = (places - before) / (self.dt * FAST_M_S)
        (x1, z1), (x2, z2), (x3, z3), (x4, z4) = (fast[:, [k, k + 1]].T for k in range(0, 8, 2))
        legs = torch.stack([x1 + x4, z1 - z4, x2 + x3, z2 - z3], 1) / 2.0
        angle = 2.0 * torch.pi * time[:, None] * torch.tensor(CLOCK_HZ, dtype=torch.float64)
        hands = torch.stack([angle.sin(), angle.cos()], 2).flatten(1)
        return torch.cat([legs, 2.0 * asked / self.limits.contraction_m - 1.0, hands], 1)

    def reward_terms(self, before: TaskState, action: Tensor, after: TaskState) -> TaskState:
        """Speed of the center of mass [cm/s]."""
        moved = self.model.observe(after["x"])[:, -1] - self.model.observe(before["x"])[:, -1]
        counts = after["step"] * self.dt > SETTLE_S + 1e-9
        return {"speed": torch.where(counts, -moved / (self.dt * UNIT_M_S), 0.0)}


class SwimSetup(Setup):
    """A training run of ``TendonSwim``; see ``diffsim.learn.Setup``.

    Its ``task_options`` hold servo, seconds, limits and body, so that a run is not resumed with
    others.
    """

    def make_task(self) -> TendonSwim:
        """The task."""
        options = self.task_options
        return TendonSwim(
            Servo(**options["servo"]),
            options["seconds"],
            Limits(**options["limits"]),
            options["body"],
        )


def swim_options(
    servo: Servo, seconds: float, limits: Limits, body: Mapping[str, float] | None = None
) -> dict[str, Any]:
    """``task_options`` of a :class:`SwimSetup`."""
    known = dict(DATA_SHEET if body is None else body)
    return {"servo": asdict(servo), "seconds": seconds, "limits": asdict(limits), "body": known}


class Steering:
    """A trained controller at the laboratory: places of markers in, contraction out.

    Args:
        net: Controller that steers.
        task: What it was trained on.
    """

    def __init__(self, net: nn.Module, task: TendonSwim):
        self.net, self.task = net, task
        self.before: Tensor | None = None
        self.action = torch.zeros(1, 1, dtype=torch.float64)
        self.asked = torch.zeros(1, 1, dtype=torch.float64)

    @torch.no_grad()
    def __call__(self, time_s: float, places: NDArray[np.float64]) -> float:
        """Contraction [m] at a time [s], the markers seen at ``places`` (8,) [m]."""
        sample = round(time_s * RATE_HZ)
        if sample % HOLD == 0:
            now = torch.from_numpy(places)[None]
            before = now if self.before is None else self.before
            seen = self.task.sense(now, before, self.asked, torch.tensor([time_s]).double())
            self.action = self.net(seen, sample // HOLD).clamp(-1.0, 1.0)
            self.before = now
        self.asked = self.task.ask(self.action, self.asked)
        return float(self.asked)
