"""``model: {system: rod}``: a slender rod that bends far, described in a study."""

from __future__ import annotations

from collections.abc import Iterator

from diffsim.causes.own import Ports
from diffsim.causes.scales import SCALES
from diffsim.core.check import did_you_mean
from diffsim.data.study import Study
from diffsim.data.study_check import Problem
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.description import (
    BaseParameters,
    chosen_effects,
    settings_with,
    unstated_facts,
)
from diffsim.systems.rod.causes import list_causes, list_numbers, measure_scales
from diffsim.systems.rod.keys import RodKeys
from diffsim.systems.rod.model import DescribedRod

MAX_EFFECTS = 6  # material, tendons, clamp, markers and weight each have causes of their own


class RodDescription(RodKeys):
    """A described rod, checked against recordings and made into a model."""

    def problems(self, study: Study) -> list[Problem]:
        """Channels and commands without a meaning, facts that runs do not state."""
        return list(self._find_problems(study))

    def _find_problems(self, study: Study) -> Iterator[Problem]:
        for channel in study.channels:
            if self.reading(channel.name) is None:
                guess = did_you_mean(
                    channel.name, [f"{m}_{a}" for m in self.markers for a in "xyz"]
                )
                yield Problem(
                    "error",
                    f"model.channels.{channel.name}",
                    f"is not described{guess}; say which marker and axis it shows",
                )
        for name in self.channels:
            if name not in [c.name for c in study.channels]:
                yield Problem("error", f"model.channels.{name}", "the study has no such channel")
        for run in study.runs:
            for i, tendon in enumerate(self.tendons):
                if tendon.command not in run.command:
                    guess = did_you_mean(tendon.command, run.command)
                    yield Problem(
                        "error",
                        f"model.tendons[{i}].command",
                        f"run {run.name} has no command {tendon.command!r}{guess}",
                    )
            if self.sessions is not None and self.sessions not in run.setup:
                guess = did_you_mean(self.sessions, run.setup)
                yield Problem(
                    "warning",
                    "model.sessions",
                    f"run {run.name} states no {self.sessions!r}{guess}; taken as of the first",
                )
        yield from unstated_facts(self.quantities(), study.runs)

    def setup(self, study: Study) -> DiagnosisSetup:
        """Model of the rod, causes that its parts allow, and options."""
        self.require_possible(study)
        parameters = BaseParameters(self.quantities(), study.runs)
        scales = measure_scales(self, study)
        model = DescribedRod(self, [c.name for c in study.channels], parameters).model()
        model.frame = {SCALES: scales.saved()}
        causes = list_causes(self, study, scales, every=bool(self.effects.only))
        advised = DiagnosisSettings(
            search=SearchSettings(max_effects=MAX_EFFECTS, num_refits=2, max_rounds=2 * MAX_EFFECTS)
        )
        return DiagnosisSetup(
            model,
            chosen_effects(causes, self.effects, study, self.ports(study)),
            settings=settings_with(advised, self.effort),
        )

    def ports(self, study: Study) -> Ports:
        """What the rod offers to causes of a user."""
        return Ports(
            scales=measure_scales(self, study),
            commands={t.command: self.between_samples for t in self.tendons},
            channels=tuple(c.name for c in study.channels),
            has_clock=self.is_in_time,
            numbers=list_numbers(self),
        )


__all__ = ["RodDescription"]
