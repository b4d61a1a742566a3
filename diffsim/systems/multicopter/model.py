"""A ready model of flights under recorded commands, made from a multicopter's design."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from scipy import sparse
from torch import Tensor

from diffsim.causes.scales import SCALES, Scales
from diffsim.causes.scene import Commands
from diffsim.causes.signals import held_lagged
from diffsim.copter import Multicopter
from diffsim.copter.vehicle.fleet import Fleet
from diffsim.core.check import require_choice
from diffsim.core.layer import may_be_differentiated
from diffsim.core.memo import Memo, memo_field
from diffsim.identify import Parameter
from diffsim.identify.effect import Effect
from diffsim.identify.model import TOGETHER, Build, Scene, SimModel
from diffsim.identify.numerics import Numerics
from diffsim.identify.starts import left_by_starts
from diffsim.systems.commands import command_of
from diffsim.systems.multicopter.cutting import (
    LONGEST,
    LONGEST_S,
    MIN_WINDOW_SAMPLES,
    MOST_RUNS,
    Cutter,
    spacing,
    thrusts_before,
)
from diffsim.systems.multicopter.figure import figure_of
from diffsim.systems.multicopter.scene import CopterScene, flight_grid, rotor_names
from diffsim.systems.multicopter.shooting import RIGID, Windows

if TYPE_CHECKING:
    from diffsim.data.study import Run
    from diffsim.identify.shape import MovingShape

FLIGHT_BASE = (
    Parameter("thrust_gain", 1.0, 0.05, log=True),
    Parameter("torque_gain", 1.0, 0.2, log=True),
    Parameter("inertia_gain", 1.0, 0.1, log=True),
    Parameter("motor_time_constant", 0.03, 0.3, "s", log=True),
)
_GROUPS = ("position", "attitude", "body_rates", "accelerometer")
_OFFSETS = ("attitude_offset", "body_rates_offset", "accelerometer_offset")
BASE_NAMES = (
    *(p.name for p in FLIGHT_BASE),
    "mass_gain",
    *(f"{o}_{axis}" for o in _OFFSETS for axis in "xyz"),
)


def flight_nuisances(
    runs: Sequence[str],
    attitude_rad: float = 3e-3,
    accelerometer_m_s2: float = 0.03,
    gain: float = 5e-3,
) -> tuple[Parameter, ...]:
    """Set-up facts that no flight is without: sensor offsets, and the thrust gain of each run."""
    spread = {"attitude_offset": attitude_rad, "accelerometer_offset": accelerometer_m_s2}
    units = {"attitude_offset": "rad", "accelerometer_offset": "m/s^2"}
    offsets = [Parameter(f"{o}_{a}", 0.0, sd, units[o]) for o, sd in spread.items() for a in "xyz"]
    return (*offsets, *(Parameter(f"thrust_gain@{run}", 1.0, gain, log=True) for run in runs))


# Noise of a channel while nothing better is known: motion capture and a small inertial unit.
SENSOR_SD = {"position": 2e-3, "attitude": 5e-3, "body_rates": 1e-2, "accelerometer": 0.1}
THRUST_COEFFICIENT = 1e-5  # of a small propeller, where a design states none [N s^2]


class CopterModel(SimModel):
    """A model that flies many parameter points as one batch.

    Args:
        flights: Recipe that makes the scene of a run.
        base: Base parameters with their priors.
    """

    def __init__(self, flights: Build, base: Sequence[Parameter]):
        super().__init__(flights, base, "multicopter")
        self.flights: Any = flights

    def scene(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor] | None = None,
        numerics: Numerics | None = None,
    ) -> Scene:
        """The run at one point; where nobody differentiates it is that point to 13 digits, by which
        it is known again: sizes come from two formulas that differ in the last one."""
        if may_be_differentiated():
            return super().scene(run, q, sizes, numerics)
        q = _round_values(q)
        there = {e: _round_values(s) for e, s in (sizes or {}).items() if s.any()}
        made = super().scene(run, q, there, numerics)
        assert isinstance(made, CopterScene)
        digits = ((e, s.numpy().tobytes()) for e, s in there.items())
        point = (self, numerics or Numerics(), q.numpy().tobytes(), *digits)
        return made.changed(point=point, note=partial(self._note_starts, run, numerics))

    def _note_starts(self, run: Run, numerics: Numerics | None, number: int) -> None:
        """Count a flight of a search for initial states; it is no prediction by itself."""
        self.simulations.add(0, round(self.cost(run, numerics) * (1.0 + TOGETHER * (number - 1))))

    def shortened(self, runs: Sequence[Run]) -> SimModel | None:
        """The model with windows half as long as the longest one of some runs.

        Returns:
            None where their length was stated, or where they have as few samples as they may.
        """
        cutter = self.flights.cutter
        lengths = {run: self.flights.windows(run).measured.shape[1] for run in runs}
        if cutter.window_s is not None or max(lengths.values(), default=0) <= MIN_WINDOW_SAMPLES:
            return None
        longest_s = 0.5 * max(length * spacing(run) for run, length in lengths.items())
        shorter = replace(self.flights, cutter=replace(cutter, longest_s=longest_s))
        made = CopterModel(shorter, self.base)
        if SCALES in self.frame:
            scales = Scales.read(self.frame[SCALES])
            shorter_scales = replace(scales, facts={**scales.facts, LONGEST: longest_s})
            made.frame = {**self.frame, SCALES: shorter_scales.saved()}
        return made

    def prepared_at(self, q: Tensor, runs: Sequence[Run] = ()) -> SimModel:
        """The model with windows as long as it settles in at these coordinates, up to a second.

        Windows of the prior may be short because a gain of the data sheet is off.

        Args:
            q: Standardized base parameters, (num_base,).
            runs: Runs that were fitted; the model itself where their windows are long already.
        """
        cutter = self.flights.cutter
        if cutter.window_s is not None or (runs and not self.short_windows(runs)):
            return self
        values = {name: v.detach() for name, v in self.values.at(q).items()}
        longer = replace(cutter, longest_s=LONGEST_S)
        made = CopterModel(replace(self.flights, cutter=longer, cut_at=values), self.base)
        made.frame = self.frame
        before, after = (
            [m.flights.windows(r).measured.shape[1] for r in runs] for m in (self, made)
        )
        return made if not runs or sum(after) > sum(before) else self

    def short_windows(self, runs: Sequence[Run]) -> Mapping[str, float]:
        """Length of the windows [s] by run, where it is shorter than what was wished for."""
        wished = self.flights.cutter.window_s or LONGEST_S
        lengths = {r: (self.flights.windows(r).measured.shape[1], spacing(r)) for r in runs}
        return {
            run.name: count * dt
            for run, (count, dt) in lengths.items()
            if count < min(max(MIN_WINDOW_SAMPLES, round(wished / dt)), len(run.time_s))
        }

    def left_of_readings(
        self, scene: Callable[[], Scene], change: sparse.csr_array
    ) -> sparse.csr_array:
        """As of ``SimModel``: each window's start state takes in what it can."""
        with torch.no_grad():
            made = scene()
            assert isinstance(made, CopterScene)
            shooting = made.find_starts()
        return left_by_starts(change, shooting.tangent, shooting.gain)

    def num_fitted_inside(self, run: Run) -> int:
        """Number of values that are fitted to a run whatever it is used for: start states."""
        scene = self.scene(run, self.at_prior())
        assert isinstance(scene, CopterScene)
        guess = scene.windows.guess
        return len(guess) * RIGID + guess.shape[1] - RIGID

    def shape_of(self, run: Run, channels: Tensor) -> MovingShape | None:
        """Arms and propellers at the poses that channels show, where they show them."""
        scene = self.scene(run, self.at_prior())
        assert isinstance(scene, CopterScene)
        return figure_of(scene, channels)

    def simulate_many(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor],
        numerics: Numerics | None = None,
    ) -> Tensor:
        """Points with the same effects in one batch: what is absent costs nothing.

        Best initial states follow by the tangents of the first point, the center of a stencil.
        """
        present = torch.stack(
            [torch.zeros(len(q), dtype=torch.bool), *((s != 0.0).any(1) for s in sizes.values())], 1
        )
        kinds, kind = torch.unique(present, dim=0, return_inverse=True)
        out = q.new_empty(len(q), *run.measured.shape)
        shooting = self._build_scene(run, q[:1], sizes, present[0, 1:], numerics).find_starts()
        for k, row in enumerate(kinds[:, 1:]):
            mine = torch.nonzero(kind == k)[:, 0]
            mine_only = {e: s[mine] for e, s in sizes.items()}
            scene = self._build_scene(run, q[mine], mine_only, row, numerics)
            out[mine] = scene.simulate_many(len(mine), shooting)
        return out

    def _build_scene(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor],
        present: Tensor,
        numerics: Numerics | None,
    ) -> CopterScene:
        there = {e: s for (e, s), on in zip(sizes.items(), present, strict=True) if on}
        scene = self.scene(run, q, {e: s[: len(q)] for e, s in there.items()}, numerics)
        assert isinstance(scene, CopterScene)
        return scene


def _round_values(values: Tensor) -> Tensor:
    """Values to 13 digits."""
    bits = values.contiguous().view(torch.int64)
    return ((bits + (1 << 7)) >> 8 << 8).view(torch.float64)


def flight_model(
    vehicle: Multicopter,
    *,
    commands: Sequence[str],
    sensors: Sequence[str] = ("position", "attitude", "body_rates", "accelerometer"),
    sensor_sd: Mapping[str, float] | None = None,
    window_s: float | None = None,
    substeps: int = 2,
    base: Sequence[Parameter] = FLIGHT_BASE,
    thrust_coefficient: float = THRUST_COEFFICIENT,
) -> CopterModel:
    """Flights of one vehicle under its recorded thrust commands.

    A run is cut into windows; the initial state of each is fitted away, so no parameter is needed
    for it (:class:`~diffsim.systems.multicopter.shooting.FlightShooting`). Channels come in the
    groups of ``sensors``, three columns each, NED; yaw must be free of jumps. A run's set-up may
    have a ``payload_kg`` at the center of mass and a ``terrain_height_m``.

    Args:
        vehicle: Vehicle as designed.
        commands: Names of the runs' commands, commanded thrust of each rotor in order [N].
        sensors: Groups of channels: "position" and "attitude", with "body_rates" and
            "accelerometer" if there are.
        sensor_sd: Noise by group, in the unit of the group; weighs the fit of initial states.
        window_s: Length of a window [s]; None: as long as the model allows, up to one second.
        substeps: Integration steps per sample.
        base: Any of thrust_gain, torque_gain (reaction torque), inertia_gain, mass_gain [-] and
            motor_time_constant [s]; without the last, motors follow at once. Nuisances as
            ``flight_nuisances`` makes them.
        thrust_coefficient: Thrust over the square of a rotor's speed [N s^2].
    """
    groups = tuple(require_choice("sensors", s, _GROUPS) for s in sensors)
    if not {"position", "attitude"} <= set(groups):
        raise ValueError(f'sensors must have "position" and "attitude", got {list(groups)}')
    if len(commands) != vehicle.num_rotors:
        raise ValueError(
            f"commands must name one column per rotor, {vehicle.num_rotors}, got {list(commands)}"
        )
    for parameter in base:
        if not parameter.name.startswith("thrust_gain@"):
            require_choice("base", parameter.name, BASE_NAMES)
    sd_of = SENSOR_SD | dict(sensor_sd or {})
    flights = Flights(
        vehicle=Fleet.of([vehicle]),
        commands=tuple(commands),
        cutter=Cutter(
            sensors=groups,
            sd=torch.tensor([sd_of[g] for g in groups for _ in range(3)], dtype=torch.float64),
            window_s=window_s,
        ),
        base=tuple(base),
        substeps=substeps,
        thrust_coefficient=thrust_coefficient,
    )
    return CopterModel(flights, tuple(base))


@dataclass(frozen=True, kw_only=True, eq=False)
class Flights:
    """Makes the scene of a run at values of the base parameters, () or (points,) each.

    Attributes:
        vehicle: Vehicle as designed, a fleet of one.
        commands: Names of the runs' commands, one per rotor.
        cutter: Groups of channels of the record and how it is cut into windows.
        base: Base parameters with their priors.
        substeps: Integration steps per sample.
        thrust_coefficient: Thrust over the square of a rotor's speed [N s^2].
        cut_at: Values of base parameters at which runs are cut; those left out, as known
            beforehand.
        known: Windows of the runs that were cut.
    """

    vehicle: Fleet
    commands: tuple[str, ...]
    cutter: Cutter
    base: tuple[Parameter, ...]
    substeps: int
    thrust_coefficient: float
    cut_at: Mapping[str, Tensor] = field(default_factory=dict)
    known: Memo[Windows] = memo_field(MOST_RUNS)

    def __call__(self, values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> CopterScene:
        return self._build_scene(values, run, numerics, self.windows(run))

    def windows(self, run: Run) -> Windows:
        """The record of a run in windows."""
        return self.cutter.kept(run, self.known, lambda: self._cut_run(run))

    def _cut_run(self, run: Run) -> Windows:
        past = thrusts_before(run, _stack_columns(run, self.commands))
        nominal = {p.name: torch.tensor(p.value, dtype=torch.float64) for p in self.base}
        nominal |= self.cut_at
        return self.cutter.cut(
            run, past, partial(self._build_scene, nominal, run, Numerics()), self.vehicle
        )

    def _build_scene(
        self, values: Mapping[str, Tensor], run: Run, numerics: Numerics, windows: Windows
    ) -> CopterScene:
        def of(name: str) -> Tensor:
            return (
                values[name].reshape(-1) if name in values else torch.ones(1, dtype=torch.float64)
            )

        gain = (of("thrust_gain") * of(f"thrust_gain@{run.name}"))[:, None, None]
        limits = self.vehicle.max_thrusts[:, None]
        asked = _stack_columns(run, self.commands).clamp(min=0.0).minimum(limits) * gain
        scene = CopterScene(
            grid=flight_grid(len(run.time_s), spacing(run)),
            numbers={n: v for n, v in values.items() if n.rpartition("_")[0] in _OFFSETS},
            commands=Commands.named(rotor_names(self.vehicle.num_rotors), asked.mT),
            fleet=self.vehicle.replace(
                mass=self.vehicle.mass * of("mass_gain") + float(run.setup.get("payload_kg", 0.0)),
                inertia=self.vehicle.inertia * of("inertia_gain")[:, None, None],
                torque_ratios=self.vehicle.torque_ratios * of("torque_gain")[:, None],
            ),
            sensors=self.cutter.sensors,
            windows=windows,
            substeps=max(1, round(self.substeps / numerics.time_step)),
            terrain_height=float(run.setup.get("terrain_height_m", 0.0)),
            thrust_coefficient=self.thrust_coefficient,
        )
        if "motor_time_constant" in values:
            tau = of("motor_time_constant")[:, None]
            scene = scene.with_command((), partial(held_lagged, time_constant=tau))
        return scene


def _stack_columns(run: Run, names: Sequence[str]) -> Tensor:
    """(1, num_samples, n_rotors) [N]."""
    return torch.stack([command_of(run, name) for name in names], -1)[None]
