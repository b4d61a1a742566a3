"""``model: {system: bench}``: static readings y = f(u; parameters), each sample for itself."""

from __future__ import annotations

from dataclasses import asdict
from typing import Literal

from pydantic import Field

from diffsim.data.study import Study
from diffsim.data.study_check import Problem
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.bench.keys import Law
from diffsim.systems.bench.law_effects import LAWS, law_effects, usual_of
from diffsim.systems.description import chosen_effects, settings_with
from diffsim.systems.ode.applying import LABELS, labels_of
from diffsim.systems.ode.described import Described, Motion
from diffsim.systems.ode.keys import FormulaKeys, Input, Inputs
from diffsim.systems.ode.names import Reader

MAX_EFFECTS = 6  # several quantities, each with causes of its own


class BenchDescription(FormulaKeys):
    """Readings as formulas of what was set or measured beside them; nothing has a memory."""

    system: Literal["bench"] = Field("bench", description="Kind of system: `bench`")
    inputs: Inputs = Field(
        (), description="What formulas may use: commands, or formulas of them; none: all commands"
    )
    laws: tuple[Law, ...] = Field(
        (), description="Definitions that are laws; opens exponents, zeros, limits, drifts of them"
    )

    def problems(self, study: Study) -> list[Problem]:
        """Mistakes in names, formulas and units, found without a simulation."""
        reader = Reader(study)
        self._described(study, reader)
        return list(reader.problems)

    def _described(self, study: Study, reader: Reader) -> Described:
        commands = dict.fromkeys(c for run in study.runs for c in run.command)
        inputs = self.inputs or tuple(Input(name=c) for c in commands if c.isidentifier())
        read = Described(self, inputs, Motion(), study, reader)
        for i, law in enumerate(self.laws):
            if law.name not in self.define and law.name not in self.tables:
                reader.report(f"laws[{i}].name", f"no definition {law.name!r}; add it to define")
            reader.parse(f"laws[{i}].of", law.of, read.known)
            reader.require_per(f"laws[{i}]", law.per)
        return read

    def setup(self, study: Study) -> DiagnosisSetup:
        """Model, candidate causes and options for a study."""
        reader = Reader(study)
        read = self._described(study, reader)
        reader.finish()
        model = read.model()
        usual = usual_of(self.laws, study, model, read.network, read.known)
        laws = law_effects(self.laws, study, usual, read.network, read.known)
        pers = {law.per for law in self.laws if law.per is not None}
        labels = {per: list(labels_of(per, study)) for per in sorted(pers)}
        model.frame = {LAWS: asdict(usual), LABELS: {**read.labels, **labels}}
        advised = DiagnosisSettings(
            search=SearchSettings(
                max_effects=MAX_EFFECTS,
                num_refits=2,
                max_rounds=2 * MAX_EFFECTS,
                rival_nats=5.0,
                unknown_steps=1,  # drifts of each run are many columns
            )
        )
        effects = chosen_effects((*laws, *read.own), self.effects)
        return DiagnosisSetup(model, effects, settings=settings_with(advised, self.effort))


__all__ = ["BenchDescription"]
