"""``model: {system: multicopter}``: flights under recorded commands, described in YAML."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from diffsim.causes.channel_groups import clock_problems
from diffsim.causes.listing import list_causes
from diffsim.causes.plant import Plant
from diffsim.causes.scales import SCALES
from diffsim.copter.vehicle.multicopter import GRAVITY
from diffsim.core.arrays import Array
from diffsim.data.study import Study
from diffsim.data.study_check import Problem
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.description import chosen_effects, missing_commands, settings_with
from diffsim.systems.multicopter.assembly import (
    assembled,
    usual_magnitudes,
    with_gust,
    with_shapes,
)
from diffsim.systems.multicopter.bank import flights_to_record
from diffsim.systems.multicopter.causes import acting_in, plant_of
from diffsim.systems.multicopter.cutting import evenly_sampled
from diffsim.systems.multicopter.described import DescribedFlights
from diffsim.systems.multicopter.frames import FRAMES
from diffsim.systems.multicopter.keys import MulticopterKeys
from diffsim.systems.multicopter.model import CopterModel
from diffsim.systems.multicopter.sensing import are_means, sensor_problems
from diffsim.systems.multicopter.unknown import wrench_of


class MulticopterDescription(MulticopterKeys):
    """A multicopter under recorded commands of its rotors."""

    commands_have_gradients, starts_as_shown = True, True

    def find_problems(self, study: Study) -> Iterator[Problem]:
        """Channels, commands and facts that the description and the study disagree on."""
        yield from sensor_problems(self.sensors, study)
        yield from clock_problems(study.channels, self.clocks)
        yield from self._find_command_problems(study)

    def build(self, study: Study) -> DescribedFlights:
        """The vehicle with its flights."""
        return assembled(self, study)

    def setup(self, study: Study) -> DiagnosisSetup:
        """Model, candidate causes and options for a study."""
        if found := self.problems(study):
            raise ValueError("\n".join(str(p) for p in found))
        study = evenly_sampled(study, self.rate, are_means(self.sensors, study))
        flights = assembled(self, study)
        scales = usual_magnitudes(flights, study)
        plant = plant_of(self, flights, study, scales)
        effects = chosen_effects(list_causes(plant), self.effects, study, plant)
        names = [e.name for e in effects]
        if "gust" in names and self.gust_frequency is None:
            scales = with_gust(flights, study, scales)
        flights = with_shapes(self, flights, study, names, scales)
        if self.causes_act_in:
            effects = tuple(acting_in(e, self.causes_act_in) for e in effects)
        model = CopterModel(flights, flights.parameters.base)
        model.frame = {SCALES: scales.saved(), FRAMES: flights.cutter.frames.saved()}
        return DiagnosisSetup(
            model,
            effects,
            (wrench_of(study.runs, plant.magnitudes["mass"] * GRAVITY),),
            flights_to_record(flights, study.runs),
            settings_with(DiagnosisSettings(), self.effort),
            study=study,
        )

    def plant(self, study: Study) -> Plant:
        """What causes of a user may change; commands are the rotors' thrusts, whatever asks for
        them."""
        study = evenly_sampled(study, self.rate, are_means(self.sensors, study))
        flights = assembled(self, study)
        return plant_of(self, flights, study, usual_magnitudes(flights, study))

    def _find_command_beyond(self, values: Array) -> str:
        """How a throttle lies outside of its range for half of the samples; empty: it does not."""
        keys, found = self.commands, values[np.isfinite(values)]
        if keys.meaning != "throttle" or not len(found):
            return ""
        middle = float(np.median(found))
        if abs(middle - 0.5 * (keys.low + keys.high)) <= 0.6 * (keys.high - keys.low):
            return ""
        return (
            f"is {middle:.4g} in SI units, outside of low {keys.low:g} to high {keys.high:g}; give "
            "these a unit, such as `low: 1000 us`"
        )

    def _find_command_problems(self, study: Study) -> Iterator[Problem]:
        # new runs of a saved model need not be of those in which its causes act
        for fact, value in self.causes_act_in.items():
            if not study.frame and not any(run.setup.get(fact) == value for run in study.runs):
                said = f"no run has {fact}: {value} in its setup"
                yield Problem("error", "model.causes_act_in", said)
        wanted = [("commands.columns", name) for name in self.commands.columns]
        if self.battery is not None:
            wanted.append(("battery", self.battery))
        yield from missing_commands([(f"model.{key}", name) for key, name in wanted], study.runs)
        for key, name in wanted:
            for run in (r for r in study.runs if name in r.command):
                if key == "commands.columns" and (
                    said := self._find_command_beyond(run.command[name])
                ):
                    yield Problem("error", "model.commands", f"run {run.name}: {name} {said}")
                    break
                if not np.isfinite(run.command[name]).all():
                    yield Problem(
                        "error",
                        f"model.{key}",
                        f"run {run.name}: command {name} has empty cells; say what they mean by "
                        "`fill` under commands, such as fill: hold",
                    )
                    break
