"""``model: {system: rod}``: a slender rod that bends far, described in a study."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from diffsim.causes.commands import CommandGroup
from diffsim.causes.listing import numbers_added
from diffsim.causes.plant import IN_TIME, LATE_RECORD, Plant
from diffsim.causes.ports import Sessions
from diffsim.causes.scales import Scales
from diffsim.core.check import did_you_mean
from diffsim.data.study import Study
from diffsim.data.study_check import Problem
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.systems.description import (
    MAX_EFFECTS,
    BaseParameters,
    missing_commands,
    undescribed_channels,
    unstated_facts,
)
from diffsim.systems.rod.keys import RodKeys
from diffsim.systems.rod.layout import TIP
from diffsim.systems.rod.model import RodModel

ROD = "rod"  # the kind of system, and its table


class RodDescription(RodKeys):
    """A described rod, checked against recordings and made into a model."""

    advised = DiagnosisSettings(
        search=SearchSettings(max_effects=MAX_EFFECTS, num_refits=2, max_rounds=2 * MAX_EFFECTS)
    )

    def find_problems(self, study: Study) -> Iterator[Problem]:
        """Channels and commands without a meaning, facts that runs do not state."""
        usual = [f"{m}_{a}" for m in self.markers for a in "xyz"]
        yield from undescribed_channels(
            study, self.channels, lambda name: self.reading(name) is not None, usual
        )
        wanted = [(f"model.tendons[{i}].command", t.command) for i, t in enumerate(self.tendons)]
        yield from missing_commands(wanted, study.runs)
        for run in study.runs:
            if self.sessions is not None and self.sessions not in run.setup:
                guess = did_you_mean(self.sessions, run.setup)
                yield Problem(
                    "warning",
                    "model.sessions",
                    f"run {run.name} states no {self.sessions!r}{guess}; taken as of the first",
                )
        yield from unstated_facts(self.quantities(), study.runs)

    def model(self, study: Study) -> RodModel:
        """The rod with its quantities as base parameters."""
        parameters = BaseParameters(self.quantities(), study.runs)
        return RodModel(self, [c.name for c in study.channels], parameters, self.zeros())

    def plant(self, study: Study) -> Plant:
        """What the rod tells of itself.

        A few poses seldom tell the shape of a command's map, or an instrument, from the rod: unless
        samples are in time, causes of these are judged where a study names some.
        """
        scales = Scales.of(study, {ROD: self._measure()})
        commands = tuple(dict.fromkeys(t.command for t in self.tendons))
        usual = scales.of_commands(commands)
        group = CommandGroup(
            commands,
            usual,
            between=self.between_samples,
            is_one_sided=scales.is_one_sided(commands),
            facts=("gain_is_fitted",) if all(t.gain.is_fitted for t in self.tendons) else (),
            unit="N",
        )
        quantities = self.quantities()
        return Plant(
            kind=ROD,
            scales=scales,
            channels=study.channels,
            commands=dict.fromkeys(commands, self.between_samples),
            ways=(group,) if commands else (),
            numbers=tuple(dict.fromkeys([*quantities, *self.zeros()])),
            fitted=tuple(name for name, q in quantities.items() if q.is_fitted),
            facts={
                IN_TIME: self.is_in_time,
                LATE_RECORD: not commands,
                "few_poses": not self.is_in_time and self.effects.only is None,
                "weighs": any(self.gravity),
                "tendons": bool(self.tendons),
                "several_tendons": len(self.tendons) > 1,
            },
            parts=self._list_parts(),
            magnitudes={**scales.plain[ROD], **usual},
            sessions=Sessions.of(self.sessions, study),
        )

    def zeros(self) -> tuple[str, ...]:
        """Numbers that causes alone change."""
        return (f"{TIP}_mass", *numbers_added(ROD, self._list_parts()))

    def _list_parts(self) -> dict[str, dict[str, str]]:
        """Tendons, markers, and the axes about which gravity may be tilted."""
        up = int(np.abs(np.array(self.gravity)).argmax())
        named = {"tendon": [t.name for t in self.tendons], "marker": [*self.markers]}
        named["level"] = [a for k, a in enumerate("xyz") if k != up]
        return {kind: {name: name for name in names} for kind, names in named.items()}

    def _measure(self) -> dict[str, float]:
        """Usual magnitudes of the rod as described."""
        volume = sum(
            np.pi / 3.0 * (b.at - a.at) * (a.radius**2 + a.radius * b.radius + b.radius**2)
            for a, b in zip(self.stations, self.stations[1:], strict=False)
        )
        return {
            "length": self.stations[-1].at,
            "thickness": self.stations[0].radius,
            "mass": float(volume * self.material.density.value),
            "youngs_modulus": self.material.youngs_modulus.value,
            "nearest": min((p.distance for t in self.tendons for p in t.path), default=1.0),
        }
