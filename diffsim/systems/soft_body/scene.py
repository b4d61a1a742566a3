"""A soft body in one run, with the places where candidate causes act."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from diffsim import soft
from diffsim.causes.channel_groups import delays_of
from diffsim.causes.interpolation import sample, straight
from diffsim.causes.scene import ForceLaw, Scene
from diffsim.causes.signals import Grid
from diffsim.contact import Obstacle
from diffsim.core.check import require
from diffsim.core.checked import checked
from diffsim.core.errors import ConvergenceError
from diffsim.soft.forces import ElasticGradient
from diffsim.soft.inputs import check_loads
from diffsim.soft.physics import LumpedVolume
from diffsim.soft.prepared import PreparedBody

if TYPE_CHECKING:
    from typing_extensions import Self

_AHEAD = {"implicit_euler": 1.0, "bdf2": 1.0, "implicit_midpoint": 0.5, "semi_implicit_euler": 0.0}
_STATIC_ITERATIONS = 60
_STATIC_RTOL = 1e-9  # of the largest displacement
CLOCK_RATE = "clock_rate"
#: Numbers that causes may change, beside those of other names in ``SoftScene.numbers``.
NUMBERS = (
    *("youngs_modulus", "poissons_ratio", "density", "rayleigh_alpha", "rayleigh_beta"),
    *("fiber_stiffness", CLOCK_RATE),
)
ANYWHERE = ""  # place of a force on all nodes
_ONE = torch.ones((), dtype=torch.float64)

OutputMap = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Moment:
    """State of one time step, which a force may depend on."""

    # x, v: positions [m] and velocities [m/s] of the nodes, (num_nodes, 3)
    x: Tensor
    v: Tensor
    time: float  # time since the start [s]
    dt: float  # time step [s]


class Force:
    """A force that may remember; made anew for every simulation.

    ``__call__`` returns nodal forces (num_nodes, 3) [N] of one moment; called once per step, in
    order.

    Attributes:
        leading_axes: Whether moments with leading axes, x and v (..., num_nodes, 3), are
            understood: then derivatives ask for many states at once.
        of_state: Whether the force depends on x and v alone, not on time or on what was before.
        reads: The physical parameters of the scene that the force depends on; None: any.
    """

    leading_axes: ClassVar[bool] = False
    of_state: ClassVar[bool] = False
    reads: tuple[str, ...] | None = None

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        raise NotImplementedError

    def factor_of(self, other: Force) -> Tensor | None:
        """How many times larger another force is at any motion, so that derivatives evaluate only
        one of them; None: it is of another form.

        Both are in scenes that differ in no more than ``reads``.
        """
        return None

    def stacked_with(self, others: Sequence[Force]) -> Force | None:
        """This force and others in one: each at its own one of the states (1 + n, num_nodes, 3) of
        a moment, so that derivatives evaluate them at once; None: each is evaluated alone.

        All are in scenes that differ in no more than ``reads``.
        """
        return None


@dataclass(frozen=True, eq=False)
class ForcePlace:
    """A point of the body and a direction, along which a force may act."""

    # (num_nodes, 3) by which the point's displacement is that of the nodes; a force at the point
    # acts on them alike
    shares: Tensor
    speed: float  # usual speed of the point [m/s]


class PointForce(Force):
    """A force by a law at a place."""

    leading_axes, of_state, reads = True, True, ()

    def __init__(self, place: ForcePlace, law: ForceLaw):
        self._shares, self._law = place.shares, law
        self._speed = torch.tensor(place.speed, dtype=torch.float64)

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        moved = ((moment.x - scene.body.x_rest) * self._shares).sum((-1, -2))
        speed = (moment.v * self._shares).sum((-1, -2))
        force = self._law.formula(
            {"size": self._law.size, "x": moved, "v": speed, "w": self._speed}
        )
        return (force[..., None, None] * self._shares).expand(moment.x.shape)


@dataclass(frozen=True, kw_only=True, eq=False)
class SoftScene(Scene):
    """One run of a soft body; effects return changed copies.

    Its grid has the times when channels were recorded, since the start of the simulation; before 0
    the body rests as it starts. Its numbers are physical parameters for ``body.physics``, scalars
    or fields, and the rate of the clock. Its commands are evenly spaced by ``command_dt``.

    Forces of hooks are evaluated at the start of steps and extrapolated from the last two to where
    the integrator wants them, which keeps its second order; stiff ones need small steps.

    Attributes:
        body: The body, with its time step and solver.
        observe: Positions (num_nodes, 3) [m] -> channels (num_channels,). Derivatives are
            quicker where it is one function for all scenes and takes leading axes.
        axes: Axis of space of every channel, 0, 1 or 2 for x, y or z, so that maps of space find
            their components.
        start: "rest" (the unstrained shape, released at 0) or "equilibrium" under the first
            command, or "given": ``start_position``.
        start_position: (num_nodes, 3) for the start "given" [m].
        start_velocity: (num_nodes, 3) at 0 [m/s]; None: at rest.
        relaxed: Parameters that the body has at rest, once hooks with memory have relaxed: the
            first guess of the equilibrium, which is iterated all the same.
        start_time: Time that the hooks' clock shows at 0 [s].
        command_dt: Time between two commands [s].
        actuate: Commands (n, width) -> activations (n, num_muscles); None: the commands themselves.
        water: Drag and thrust of a fluid, explicit; None: there is none.
        current: Velocity of the fluid, which every drag force is relative to, (3,) [m/s].
        fluid_density: Density of the fluid for added mass [kg/m^3].
        friction_shares: (num_nodes,) of dry friction, summing to 1; None: evenly by volume.
        clock_offset: The record's clock is late by this [s].
        place_maps: Functions of what is observed (num_samples, width) and sample times that change
            it before the output maps, in order.
        rest_places: (width,) what is observed of the body at rest, where that is places of markers,
            x, y and z of each; None: something else is observed.
        output_maps: Functions of channels (num_samples, num_channels) and sample times that change
            the channels before the instruments do, in order.
        pressurize: Commands (n, width) -> pressures (n, num_chambers) [Pa]; None: no chambers.
        places: Places at which causes may put a force, by name.
        hung_mass: (num_nodes,) what hangs from each node as a force only [kg]; None: nothing.
        obstacles: What the body meets; see :class:`diffsim.contact.Obstacle`.
    """

    body: soft.SoftBody
    observe: Callable[[Tensor], Tensor]
    axes: tuple[int, ...]
    numbers: Mapping[str, Tensor] = field(default_factory=dict)
    start: str = "rest"
    start_position: Tensor | None = None
    start_velocity: Tensor | None = None
    relaxed: Mapping[str, Tensor] = field(default_factory=dict)
    start_time: float = 0.0
    command_dt: float = math.nan
    actuate: Callable[[Tensor], Tensor] | None = None
    water: soft.Hydrodynamics | None = None
    current: Tensor = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))
    fluid_density: float = 1000.0
    friction_shares: Tensor | None = None
    clock_offset: Tensor = field(default_factory=lambda: torch.zeros((), dtype=torch.float64))
    place_maps: tuple[OutputMap, ...] = ()
    rest_places: Tensor | None = None
    output_maps: tuple[OutputMap, ...] = ()
    pressurize: Callable[[Tensor], Tensor] | None = None
    places: Mapping[str, ForcePlace] = field(default_factory=dict)
    hung_mass: Tensor | None = None
    obstacles: tuple[Obstacle, ...] = ()

    @checked(kinds_only=True)
    def number(self, name: str) -> Tensor:
        """A physical parameter as it is in this run, 0 where the body has none; or the rate of the
        clock."""
        if name in self.numbers:
            return self.numbers[name]
        value: Tensor | None = _ONE if name == CLOCK_RATE else getattr(self.body, name)
        return torch.zeros((), dtype=torch.float64) if value is None else value

    @cached_property
    def parameters(self) -> Mapping[str, Tensor]:
        """Physical parameters for ``body.physics`` by name."""
        return {name: v for name, v in self.numbers.items() if name != CLOCK_RATE}

    @checked(kinds_only=True)
    def with_parameter(self, name: str, value: Tensor) -> Self:
        """A copy with one physical parameter replaced."""
        return self.changed(numbers={**self.numbers, name: value})

    @checked(kinds_only=True)
    def with_hook(self, make: Callable[[], Force]) -> Self:
        """A copy with one more force on the nodes."""
        return self.changed(forces=(*self.forces, (ANYWHERE, make)))

    @checked(kinds_only=True)
    def with_places(self, change: OutputMap) -> Self:
        """A copy whose observed places are changed: f(places, times) -> places."""
        return self.changed(place_maps=(*self.place_maps, change))

    @property
    def makers(self) -> tuple[Callable[[], Force], ...]:
        """Functions that make the extra forces of a rollout, in order."""
        return tuple(
            law if place == ANYWHERE else partial(PointForce, self.places[place], law)
            for place, law in self.forces
        )

    @property
    def sample_times(self) -> Tensor:
        """When channels were recorded, since the start of the simulation, (num_samples,) [s]."""
        return self.grid.times

    @property
    def is_commanded(self) -> bool:
        """Whether there is any command."""
        return len(self.commands.values) > 0

    @property
    def solid_mass(self) -> Tensor:
        """Mass of the solid at each node, (num_nodes,) [kg]."""
        body, density = self.body, self.number("density")
        volume = LumpedVolume(
            elements=body.mesh.elements, shares=body.nodal_shares, nodal=body.nodal_volume
        )
        return volume.mass(density)

    @property
    def inert_mass(self) -> Tensor:
        """Mass at each node that a moving frame acts on, (num_nodes,) [kg]."""
        return self.solid_mass + self.number("attached_mass") + self.number("added_mass")

    def solid_force(self) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
        """Force of the solid without fibers, as a function of x (..., num_nodes, 3) [m].

        It returns the elastic force, shape of x [N], and the mean square strain (...) [-]: that of
        a bar with the same energy, 2 U / (E V), whatever E.
        """
        body = self.body
        values: dict[str, Any] = dict(self.parameters)
        # share of the fibers' stiffness that is left in the solid's own force
        values["fiber_stiffness"] = 1e-12 * self.number("fiber_stiffness")
        physics = body.physics(**values)
        # a field of moduli weighs the strain
        scale = 0.5 * self.number("youngs_modulus").mean() * body.nodal_volume.sum()
        return SolidForce(PreparedBody(body, physics), scale)

    def simulate(self) -> Tensor:
        """Predicted channels, (num_samples, num_channels)."""
        return self.channels(self.motion(self.num_steps()))

    def motion(self, num_steps: int) -> Tensor:
        """Observed channels at every step, (num_steps + 1, ...)."""
        activations, pressures = self.activations(num_steps), self.pressures(num_steps)
        physics = self.body.physics(**self.parameters)
        return soft.rollout(
            self.body,
            self.initial_state(None if activations is None else activations[0], physics),
            num_steps,
            external_force=self._make_external_force(),
            activation=None if activations is None else lambda k, state: activations[k],
            pressure=None if pressures is None else lambda k, state: pressures[k],
            obstacles=list(self.obstacles) or None,
            physics=physics,
            keep=lambda state: self.observe(state.x),
        ).x

    def num_steps(self) -> int:
        """Steps that the record needs."""
        delays = (None, *delays_of(self._split_clocks()[1]).values())
        last = max(float(self._compute_times(d).detach().max()) for d in delays)
        # two more than asked for: the interpolation looks that far ahead
        return max(5, math.ceil(last / self.body.dt - 1e-9) + 2)

    def channels(self, observed: Tensor) -> Tensor:
        """Recorded channels from (num_steps + 1, num_channels), observed at every step."""
        return self.by_clock(lambda times: sample(observed, self.body.dt, times))

    def by_clock(self, observed_at: Callable[[Tensor], Tensor]) -> Tensor:
        """Recorded channels, each at the times of its instrument.

        Args:
            observed_at: What is observed at times (num_samples,) [s], since the start.
        """
        out = self.shown(observed_at(self._compute_times()))
        for channels, delay in delays_of(self._split_clocks()[1]).items():
            own = torch.zeros(out.shape[-1], dtype=torch.bool)
            own[list(channels)] = True
            out = torch.where(own, self.shown(observed_at(self._compute_times(delay))), out)
        return out

    def shown(self, observed: Tensor) -> Tensor:
        """Recorded channels from what is observed at the sample times."""
        for change in (*self.place_maps, *self.output_maps):
            observed = change(observed, self.sample_times)
        return self.instruments.read(observed, self.grid)

    def _compute_times(self, delay: Tensor | None = None) -> Tensor:
        """Times that are shown, since the start [s]."""
        late = self.clock_offset
        for of_all in self._split_clocks()[0]:
            late = late + of_all
        since = self.sample_times - late
        return (since if delay is None else since - delay) * self.number(CLOCK_RATE)

    def _split_clocks(self) -> tuple[list[Tensor], list[tuple[tuple[int, ...], Tensor]]]:
        """How late the whole record is, and instruments of some channels [s]."""
        clocks, every = self.instruments.clocks, (0, len(self.axes))
        whole = [delay for channels, delay in clocks if len(channels) in every]
        return whole, [(c, delay) for c, delay in clocks if len(c) not in every]

    def initial_state(self, activation: Tensor | None, physics: soft.Physics) -> soft.State:
        """State in which the body starts, under the first activation."""
        state = self.body.rest_state()
        if self.start == "equilibrium":
            state = self._find_first_equilibrium(activation, physics)
        x = state.x if self.start_position is None else self.start_position
        return soft.State(x, state.v if self.start_velocity is None else self.start_velocity)

    def _find_first_equilibrium(
        self, activation: Tensor | None, physics: soft.Physics
    ) -> soft.State:
        """At rest under the first command and all hooks' forces."""
        pressures = self.pressures(1)
        pressure = None if pressures is None else pressures[0]
        return self.equilibrium(activation, physics, pressure=pressure)

    def equilibrium(
        self,
        activation: Tensor | None,
        physics: soft.Physics,
        *,
        pressure: Tensor | None = None,
        guess: Tensor | None = None,
    ) -> soft.State:
        """At rest under commands and all hooks' forces at time 0.

        Args:
            activation: Activations of the muscles, (num_muscles,); None: none.
            physics: Parameters of the body.
            pressure: Pressures of the chambers, (num_chambers,) [Pa]; None: none.
            guess: Places to begin from, (num_nodes, 3) [m]; None: the unstrained shape.
        """
        relaxed = {**self.parameters, **self.relaxed}
        loads = {"activation": activation, "pressure": pressure}
        state = self.body.static_equilibrium(
            guess=guess,
            physics=self.body.physics(**relaxed) if self.relaxed else physics,
            **loads,
        )
        if not self.forces and self.water is None:
            return state
        change, before = math.inf, state.x.detach()
        for _ in range(_STATIC_ITERATIONS):
            force = self.force_at(0, state, [make() for make in self.makers])
            if not bool(torch.isfinite(force).all()):
                break  # it runs away
            before = state.x.detach()
            state = self.body.static_equilibrium(
                guess=before,
                external_force=force,
                physics=physics,
                **loads,
            )
            change = float((state.x.detach() - before).abs().max())
            if change <= _STATIC_RTOL * float((before - self.body.x_rest).abs().max()):
                return state
        raise ConvergenceError(
            f"no equilibrium with the extra forces: after {_STATIC_ITERATIONS} iterations the body "
            f"still moves by {change:.1e} m; reduce the effects' sizes",
            residual_norm=change,
            tolerance=_STATIC_RTOL * float((before - self.body.x_rest).abs().max()),
            num_iters=_STATIC_ITERATIONS,
        )

    def activations(self, num_steps: int) -> Tensor | None:
        """Activation of every step: the command where the integrator wants it."""
        if not self.is_commanded or not self.body.muscles.num_muscles:
            return None
        at_steps = self.commands_at_steps(num_steps)
        return at_steps if self.actuate is None else self.actuate(at_steps)

    def pressures(self, num_steps: int) -> Tensor | None:
        """Pressure of every chamber in every step, (num_steps, num_chambers) [Pa]."""
        if self.pressurize is None:
            return None
        return self.pressurize(self.commands_at_steps(num_steps))

    def command_heard(self) -> Tensor:
        """The command (num_commands, width) as it arrives."""
        count = self.commands.values.shape[-1]
        return self.commands.heard(Grid.even(count, self.command_dt)).mT

    def commands_at_steps(self, num_steps: int) -> Tensor:
        """The command as it arrives, in every step, (num_steps, width)."""
        times = self.body.dt * (torch.arange(num_steps, dtype=torch.float64) + self.ahead)
        return straight(self.command_heard(), self.command_dt, times)

    @property
    def ahead(self) -> float:
        """What explicit forces are extrapolated to, in steps ahead of the step's start."""
        return _AHEAD[self.body.integrator]

    def _make_external_force(self) -> Callable[[int, soft.State], Tensor] | None:
        """All hooks' forces, extrapolated; remembers, so it serves one rollout."""
        if not self.forces and self.water is None:
            return None
        forces = [make() for make in self.makers]
        before: list[Tensor] = []

        def total(k: int, state: soft.State) -> Tensor:
            now = self.force_at(k, state, forces)
            past = before.pop() if before else now
            before.append(now)
            return now + self.ahead * (now - past)

        return total

    def time_of(self, k: int) -> float:
        """Time that the hooks' clock shows at the start of step k [s]."""
        return self.start_time + k * self.body.dt

    def force_at(self, k: int, state: soft.State, forces: Sequence[Force]) -> Tensor:
        """Sum of the hooks' forces at the start of step k, (num_nodes, 3) [N]."""
        dt = self.body.dt
        moment = Moment(state.x, state.v, self.time_of(k), dt)
        found = [force(self, moment) for force in forces]
        if self.water is not None:
            found.insert(0, self.water(state.x, state.v, water_velocity=self.current))
        return sum(found[1:], found[0]) if found else torch.zeros_like(state.x)


class SolidForce:
    """Force of a solid at places, see :meth:`SoftScene.solid_force`.

    Args:
        prepared: The body without fibers.
        scale: Energy of the mean square strain one, E V / 2 [J].
    """

    def __init__(self, prepared: PreparedBody, scale: Tensor):
        self._prepared, self._scale = prepared, scale
        self._gradients: dict[tuple[int, ...], ElasticGradient] = {}

    def __call__(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Force, shape of x (..., num_nodes, 3) [m], and mean square strain (...) [-]."""
        shape = tuple(x.shape)
        if shape not in self._gradients:
            x = require("x", x, ("...", self._prepared.body.mesh.num_nodes, 3))
            self._gradients[shape] = ElasticGradient(check_loads(self._prepared, shape, {}))
        gradient, energy = self._gradients[shape](x)
        return -gradient, energy / self._scale
