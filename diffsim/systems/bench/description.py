"""``model: {system: bench}``: static readings y = f(u; parameters), each sample for itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from pydantic import Field
from torch import Tensor

from diffsim.causes.catalogue import rows
from diffsim.causes.listing import list_causes
from diffsim.causes.plant import Plant
from diffsim.causes.readings import SENSOR
from diffsim.causes.row import spell_plainly
from diffsim.causes.scales import SCALES, Scales
from diffsim.core.schema import fill_in
from diffsim.data.study import Channel, Run, Study
from diffsim.data.study_check import Problem
from diffsim.identify.effect import Effect
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.law import LAWS
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.description import MAX_EFFECTS, chosen_effects, settings_with
from diffsim.systems.ode.applying import LABELS, labels_of_blocks
from diffsim.systems.ode.described import DescribedMotion, FormulaSystem
from diffsim.systems.ode.keys import FormulaKeys, Input, Inputs
from diffsim.systems.ode.law_effects import law_effects, unknown_laws
from diffsim.systems.ode.law_port import OdeLaws
from diffsim.systems.ode.library import library_of
from diffsim.systems.ode.names import Reader
from diffsim.systems.ode.reading import read_system
from diffsim.systems.ode.scene import OdeScene

MIN_FIT_RUNS = 3  # runs to fit: of two, one zero for both and their difference are alike


class BenchDescription(FormulaKeys):
    """Readings as formulas of what was set or measured beside them; nothing has a memory."""

    system: Literal["bench"] = Field("bench", description="Kind of system: `bench`")
    inputs: Inputs = Field(
        (), description="What formulas may use: commands, or formulas of them; none: all commands"
    )

    def problems(self, study: Study) -> list[Problem]:
        """Mistakes in names, formulas and units, found without a simulation."""
        reader = Reader(study)
        self._read_model(study, reader)
        return sorted(reader.problems, key=lambda p: p.severity == "note")

    def _read_model(self, study: Study, reader: Reader) -> FormulaSystem:
        commands = dict.fromkeys(c for run in study.runs for c in run.command)
        inputs = self.inputs or tuple(Input(name=c) for c in commands if c.isidentifier())
        return read_system(self, inputs, DescribedMotion(), study, reader)

    def setup(self, study: Study) -> DiagnosisSetup:
        """Model, candidate causes and options for a study."""
        reader = Reader(study)
        read = self._read_model(study, reader)
        reader.finish()
        library = library_of(read)
        model, scales = library.model, library.scales
        model.frame = {
            LABELS: labels_of_blocks((*self.effects.formulas, *self.laws), study),
            SCALES: scales.saved(),
        }
        # what differs between groups of a search for faults is their stated scatter, and no fault
        channels = enumerate(study.channels if study.faults is None else ())
        zeros = (_run_zero(study, i, channel, scales) for i, channel in channels)
        advised = DiagnosisSettings(
            search=SearchSettings(
                max_effects=MAX_EFFECTS,
                num_refits=2,
                max_rounds=2 * MAX_EFFECTS,
                rival_nats=5.0,
                unknown_steps=1,  # drifts of each run are many columns
            )
        )
        plant = Plant(
            kind="bench",
            scales=scales,
            channels=study.channels,
            commands=dict.fromkeys(read.held, "straight"),
            numbers=tuple(read.base.quantities),
        )
        own = {cause.name for cause in self.effects.own}
        own -= {law["name"] for law in study.frame.get(LAWS) or ()}
        # where a law is stated, its gain, zero and curvature are those of the reading
        sensors = () if self.laws or own else list_causes(replace(plant, kind=SENSOR))
        found = (*law_effects(library), *sensors, *zeros, *read.own)
        return DiagnosisSetup(
            model,
            chosen_effects(found, self.effects, study, plant),
            unknowns=unknown_laws(library),
            settings=settings_with(advised, self.effort),
            laws=OdeLaws(
                library=library,
                model=library.model,
                study=library.study,
                whole=library.study,
                make=self.setup,
            ),
        )


def _run_zero(study: Study, at: int, channel: Channel, scales: Scales) -> Effect:
    """A zero that is another one in each run: scales are tared by hand, amplifiers warm up.

    Its components are called after the runs, as nuisances are ("...@run"). So a run that no fit has
    seen tells its own, and nothing else is fitted to it.
    """
    names = [r.name for r in study.runs if np.isfinite(r.measured[:, at]).any()]
    places = {name: k for k, name in enumerate(names)}
    row = rows("ode")["zero_per_run"]
    return row.effect(
        partial(_shift_run, channel=at, places=places),
        scales.of_channels((channel.name,)),
        ending=f"_of_{spell_plainly(channel.name)}",
        form=fill_in(row.form, {"channel": channel.name}),
        family=f"{row.family}_of_{channel.name}",
        unit=channel.unit,
        shown_unit=None if channel.shown_formula else channel.shown_unit,
        components=tuple(f"@{name}" for name in names) or ("size",),
        needs=partial(_need_runs, at=at),
    )


def _need_runs(study: Study, *, at: int) -> str | None:
    found = [r for r in study.fit_runs if np.isfinite(r.measured[:, at]).any()]
    return None if len(found) >= MIN_FIT_RUNS else f"{MIN_FIT_RUNS} runs to fit"


def _shift_run(
    scene: OdeScene, size: Tensor, run: Run, *, channel: int, places: Mapping[str, int]
) -> OdeScene:
    if run.name not in places:
        return scene
    zero = size[..., places[run.name], None, None]
    return scene.with_reading((channel,), lambda y, grid: y + zero)
