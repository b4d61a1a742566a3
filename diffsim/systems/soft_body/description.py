"""``model: {system: soft_body}``: any soft body, described in a study."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from diffsim.causes import Scales
from diffsim.causes.channel_groups import channels_of, clock_of, clock_problems
from diffsim.causes.listing import list_causes
from diffsim.causes.plant import Plant
from diffsim.causes.scales import SCALES
from diffsim.data.study import Run, Study
from diffsim.data.study_check import Problem
from diffsim.identify import Jacobian
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.description import (
    BaseParameters,
    chosen_effects,
    fact_in,
    missing_commands,
    settings_with,
    undescribed_channels,
    unstated_facts,
)
from diffsim.systems.soft_body.body_keys import SoftBodyKeys
from diffsim.systems.soft_body.causes import (
    command_reach,
    plant_of,
    scales_of,
    unknowns,
    usual_motion,
)
from diffsim.systems.soft_body.described import DescribedModel
from diffsim.systems.soft_body.quasi_static import pose_commands
from diffsim.systems.soft_body.rig import BodyRig


class SoftBodyDescription(SoftBodyKeys):
    """A described soft body, checked against recordings and made into a model."""

    commands_have_gradients = True

    def find_problems(self, study: Study) -> Iterator[Problem]:
        """Channels and commands without a meaning."""
        yield from undescribed_channels(
            study, self.channels, self.channels.__contains__, self.channels
        )
        yield from clock_problems(study.channels, self.clocks)
        yield from self._find_problems_of_runs(study.runs)

    def build(self, study: Study) -> BodyRig:
        """The body: no region is without nodes, no point outside."""
        return self._build_model(study).rig()

    def _find_problems_of_runs(self, runs: Sequence[Run]) -> Iterator[Problem]:
        wanted = [(f"model.{k}[{i}].command", d.command) for k in ("tendons", "muscles", "chambers")
                  for i, d in enumerate(getattr(self, k))]  # fmt: skip
        if self.support is not None:
            wanted += [("model.support.x", self.support.x), ("model.support.z", self.support.z)]
        yield from missing_commands(wanted, runs)
        for i, load in enumerate(self.masses):
            have = [load.mass_from in run.setup for run in runs]
            if load.mass_from is not None and not any(have):
                yield Problem(
                    "error",
                    f"model.masses[{i}].mass_from",
                    f"no run states {load.mass_from!r} in its setup",
                )
            elif load.mass_from is not None:
                yield from _find_problems_of_masses(
                    f"model.masses[{i}].mass_from", load.mass_from, runs
                )
        yield from unstated_facts(self.quantities(), runs)

    def setup(self, study: Study) -> DiagnosisSetup:
        """Model of the body, causes that its parts allow, and options."""
        self.require_possible(study)
        described = self._build_model(study)  # once: its mesh is costly
        plant, model = self._make_plant(study, described), described.model()
        model.frame = {SCALES: plant.scales.saved()}
        advised = DiagnosisSettings(
            search=SearchSettings(max_effects=3, num_refits=2, max_rounds=4),
            # prior sd: a larger step sees tendons go slack and taut again
            jacobian=Jacobian(step=1e-4) if self.tendons else Jacobian(),
            noise_rounds=1,
        )
        return DiagnosisSetup(
            model,
            chosen_effects(list_causes(plant), self.effects, study, plant),
            unknowns=unknowns(self, study, plant.scales),
            settings=settings_with(advised, self.effort),
        )

    def plant(self, study: Study) -> Plant:
        """What the body tells of itself."""
        return self._make_plant(study, self._build_model(study))

    def _make_plant(self, study: Study, described: DescribedModel) -> Plant:
        scales = self._measure_scales(study, described)
        return plant_of(self, study, scales, described.rig().places)

    def _measure_scales(self, study: Study, described: DescribedModel) -> Scales:
        mass_kg = float(described.rig().volume.sum()) * self.material.density.value
        return scales_of(self, study, mass_kg)

    def _build_model(self, study: Study) -> DescribedModel:
        parameters = BaseParameters(self.quantities(), study.runs)
        names = [c.name for c in study.channels]
        fitted, commands = Scales.kept_in(study) or Scales.of_runs(study), None
        if len(self.commands) == 1:
            reach = command_reach(fitted, self.commands)
            now = _reach_of_runs(study.runs, self.commands[0])
            commands = pose_commands(reach, now, self.numerics.poses)
        clocks = {
            clock_of(name): tuple(names.index(c) for c in own)
            for name, own in self._list_late(study).items()
        }
        speed = usual_motion(self, fitted)["speed"]
        return DescribedModel(self, study.folder, names, parameters, commands, clocks, speed)

    def _list_late(self, study: Study) -> dict[str, tuple[str, ...]]:
        """Channels of each stated clock."""
        return {name: channels_of(study.channels, name) for name in self.clocks}


def _reach_of_runs(runs: Sequence[Run], command: str) -> tuple[float, float]:
    """Least and greatest value of a command in runs of any use, 0 included."""
    every = np.concatenate([np.asarray(run.command[command], dtype=np.float64) for run in runs])
    known = every[np.isfinite(every)]
    return min(0.0, float(known.min())), max(0.0, float(known.max()))


def _find_problems_of_masses(where: str, fact: str, runs: Sequence[Run]) -> Iterator[Problem]:
    """Facts that are no mass, and runs that do not state theirs."""
    for run in runs:
        try:
            fact_in(run, fact, "kg")
        except ValueError as error:
            yield Problem("error", where, str(error))
            return
    if silent := [run.name for run in runs if fact not in run.setup]:
        told = f"{', '.join(silent[:4])}{' ...' if len(silent) > 4 else ''}"
        yield Problem("warning", where, f"0 kg is taken where the setup has no {fact}: {told}")
