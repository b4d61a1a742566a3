"""The scene of a run of a described multicopter."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor

from diffsim.causes.scene import Commands
from diffsim.causes.signals import held_delayed, held_lagged
from diffsim.copter import Multicopter
from diffsim.copter.vehicle.multicopter import Fleet
from diffsim.core.memo import Memo, memo_field
from diffsim.data.study import Run
from diffsim.identify.numerics import Numerics
from diffsim.systems.description import BaseParameters, fact_in
from diffsim.systems.multicopter.cutting import Cutter, spacing, thrusts_before
from diffsim.systems.multicopter.effects import ESTIMATOR_GAINS
from diffsim.systems.multicopter.keys import RotorKeys
from diffsim.systems.multicopter.lag import speed_lagged
from diffsim.systems.multicopter.scene import CopterScene, flight_grid, rotor_names
from diffsim.systems.multicopter.shooting import Windows
from diffsim.systems.multicopter.thrust_law import ThrustLaw, described_fleet, designed_fleet

_OFFSET = re.compile(r"(attitude|body_rates|specific_force)_offset_[xyz]")
_SHAPES = ("sling_length", "gust_frequency", *(f"estimator_{name}" for name in ESTIMATOR_GAINS))
PAYLOAD, TERRAIN = "payload_kg", "terrain_height_m"


@dataclass(frozen=True, kw_only=True, eq=False)
class DescribedFlights:
    """Makes the scene of a run at values of the base parameters, () or (points,) each."""

    parameters: BaseParameters  # quantities of the description by name
    law: ThrustLaw  # from commands to thrusts
    rotors: tuple[RotorKeys, ...]  # places, senses and axes; empty with a design
    design: Multicopter | None  # vehicle as designed; None: its quantities are given
    cutter: Cutter  # groups of readings, and how records are cut into windows
    substeps: int  # integration steps per sample
    radius: float  # of the propellers [m]; 0: unknown
    max_thrust: float | None  # of a rotor, beyond which no command goes; None: unlimited [N]
    full_thrust: float  # to which the curvature of the thrust refers [N]
    thrust_coefficient: float  # thrust over the square of a rotor's speed [N s^2]
    lags_speed: bool  # whether it is the speed, not the thrust, that lags
    # indices of the channels that are late together, by the quantity that says how much
    clocks: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    # values of base parameters at which runs are cut; those left out, as known beforehand
    cut_at: Mapping[str, Tensor] = field(default_factory=dict)
    known: Memo[Windows] = memo_field()  # windows of the runs that were cut

    def __call__(self, values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> CopterScene:
        return self._build_scene(values, run, numerics, self.windows(run))

    def windows(self, run: Run) -> Windows:
        """The record of a run in windows."""
        return self.cutter.kept(run, self.known, lambda: self._cut_run(run))

    def _cut_run(self, run: Run) -> Windows:
        nominal = {**self.nominal(), **self.cut_at}
        past = thrusts_before(run, self.asked(run, self.in_run(nominal, run)))
        return self.cutter.cut(
            run, past, partial(self._build_scene, nominal, run, Numerics()), self.nominal_fleet()
        )

    def nominal(self) -> dict[str, Tensor]:
        """Best guesses of the base parameters beforehand."""
        return {p.name: torch.tensor(p.value, dtype=torch.float64) for p in self.parameters.base}

    def in_run(self, values: Mapping[str, Tensor], run: Run) -> dict[str, Tensor]:
        """Quantities of a run by name; those of a run that was never recorded as known beforehand.

        Args:
            values: Values of the base parameters by name, () or (points,) each.
        """
        known = {
            self.parameters.name_of(key, run): torch.tensor(q.value, dtype=torch.float64)
            for key, q in self.parameters.quantities.items()
            if q.is_fitted and q.per is not None
        }
        return self.parameters.in_run({**known, **values}, run)

    def asked(self, run: Run, v: Mapping[str, Tensor]) -> Tensor:
        """Thrusts that are asked for, (points, num_samples, n_rotors) [N].

        Args:
            v: Quantities of the run by name, () or (points,) each.
        """
        count = len(self.law.commands.columns)
        shares = [v[f"rotor_{i + 1}_share"].reshape(-1) for i in range(count)]
        gain = (v["thrust_gain"] * v["run_thrust_gain"]).reshape(-1)
        gains = gain[:, None] * torch.stack(torch.broadcast_tensors(*shares), -1)
        thrusts = self.law.thrusts(run, v)
        if self.max_thrust is not None:
            thrusts = thrusts.clamp(max=self.max_thrust)
        return thrusts * gains[:, None]

    def nominal_fleet(self) -> Fleet:
        """The vehicle as best known beforehand, (1, ...)."""
        known = {k: q.value for k, q in self.parameters.quantities.items()}
        return self._build_fleet(
            {k: torch.tensor(v, dtype=torch.float64) for k, v in known.items()}
        )

    def _build_fleet(self, v: Mapping[str, Tensor]) -> Fleet:
        if self.design is None:
            return described_fleet(v, self.rotors, self.cutter.frames, self.radius)
        return designed_fleet(v, self.design, self.cutter.frames)

    def _build_scene(
        self, values: Mapping[str, Tensor], run: Run, numerics: Numerics, windows: Windows
    ) -> CopterScene:
        v = self.in_run(values, run)
        fleet = self._build_fleet(v)
        fleet = fleet.replace(
            mass=fleet.mass + fact_in(run, PAYLOAD, "kg"),
            inertia=fleet.inertia * v["inertia_gain"].reshape(-1, 1, 1),
            torque_ratios=fleet.torque_ratios * v["torque_gain"].reshape(-1, 1),
            max_thrusts=torch.full_like(fleet.max_thrusts, self.full_thrust),
        )
        numbers = {
            name.replace("specific_force", "accelerometer"): value
            for name, value in v.items()
            if name in _SHAPES or _OFFSET.fullmatch(name)
        }
        scene = CopterScene(
            grid=flight_grid(len(run.time_s), spacing(run)),
            numbers=numbers,
            commands=Commands.named(rotor_names(fleet.num_rotors), self.asked(run, v).mT),
            fleet=fleet,
            sensors=self.cutter.sensors,
            windows=windows,
            columns=self.cutter.columns,
            frames=self.cutter.frames,
            substeps=max(1, round(self.substeps / numerics.time_step)),
            terrain_height=fact_in(run, TERRAIN, "m"),
            thrust_coefficient=self.thrust_coefficient,
        )
        return self._delay_signals(scene, v)

    def _delay_signals(self, scene: CopterScene, v: Mapping[str, Tensor]) -> CopterScene:
        """Clock and lag of the commands, clocks of sensors."""
        if "clock" in v:
            late = v["clock"].reshape(-1, 1)
            comes_late = partial(held_delayed, delay=late, signed=False)
            scene = scene.with_command((), comes_late)
        if "motor_lag" in v:
            tau = v["motor_lag"].reshape(-1, 1)
            lagged = speed_lagged if self.lags_speed else held_lagged
            scene = scene.with_command((), partial(lagged, time_constant=tau))
        for name, channels in self.clocks.items():
            scene = scene.with_clock(channels, v[name])
        return scene
