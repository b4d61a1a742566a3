"""``model: {system: bench}``: static readings y = f(u; parameters), each sample for itself."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from pydantic import Field

from diffsim.causes.own import Ports
from diffsim.causes.scales import SCALES, Scales
from diffsim.data.study import Study
from diffsim.data.study_check import Problem
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.bench.run_zeros import run_zeros
from diffsim.systems.description import chosen_effects, settings_with
from diffsim.systems.ode.applying import LABELS, labels_of_blocks
from diffsim.systems.ode.described import DescribedMotion, FormulaSystem, model_of
from diffsim.systems.ode.keys import FormulaKeys, Input, Inputs, Law
from diffsim.systems.ode.law_effects import (
    check_laws,
    law_effects,
    law_scales,
    unknown_laws,
)
from diffsim.systems.ode.law_port import OdeLaws
from diffsim.systems.ode.names import Reader
from diffsim.systems.ode.reading import read_system

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
        self._read_model(study, reader)
        return list(reader.problems)

    def _read_model(self, study: Study, reader: Reader) -> FormulaSystem:
        commands = dict.fromkeys(c for run in study.runs for c in run.command)
        inputs = self.inputs or tuple(Input(name=c) for c in commands if c.isidentifier())
        read = read_system(self, inputs, DescribedMotion(), study, reader)
        check_laws(self.laws, (*self.define, *self.tables), read.known, reader)
        return read

    def setup(self, study: Study) -> DiagnosisSetup:
        """Model, candidate causes and options for a study."""
        reader = Reader(study)
        read = self._read_model(study, reader)
        reader.finish()
        model = model_of(read)
        scales = Scales.kept_in(study) or Scales.of_runs(study)
        bends = law_scales(self.laws, study, model, read.network, read.known)
        scales = replace(scales, plain={**scales.plain, **bends})
        model.frame = {
            LABELS: labels_of_blocks((*self.effects.formulas, *self.laws), study),
            SCALES: scales.saved(),
        }
        laws = law_effects(self.laws, study, scales, read.network, read.known)
        # what differs between groups of a search for faults is their stated scatter, and no fault
        zeros = run_zeros(study, scales) if study.faults is None else ()
        advised = DiagnosisSettings(
            search=SearchSettings(
                max_effects=MAX_EFFECTS,
                num_refits=2,
                max_rounds=2 * MAX_EFFECTS,
                rival_nats=5.0,
                unknown_steps=1,  # drifts of each run are many columns
            )
        )
        ports = Ports(
            scales=scales,
            commands={name: "straight" for name in read.input_held},
            channels=tuple(c.name for c in study.channels),
            numbers=tuple(read.base.quantities),
        )
        effects = chosen_effects((*laws, *zeros, *read.own), self.effects, study, ports)
        return DiagnosisSetup(
            model,
            effects,
            unknowns=unknown_laws(self.laws, study, model, read.network, read.known),
            settings=settings_with(advised, self.effort),
            laws=OdeLaws(read, None, study, model, self.setup),
        )


__all__ = ["BenchDescription"]
