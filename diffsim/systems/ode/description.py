"""``model: {system: ode}``: states, rates and readings as formulas."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from diffsim.causes.channel_groups import CLOCKS
from diffsim.causes.scales import HELD, SCALES
from diffsim.core.schema_numbers import Seconds
from diffsim.core.schema_paths import NAMED_CODE, PathWords
from diffsim.data.study import Study
from diffsim.data.study_check import Problem
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.description import chosen_effects, settings_with
from diffsim.systems.ode.applying import LABELS, labels_of_blocks
from diffsim.systems.ode.described import DescribedMotion, FormulaSystem
from diffsim.systems.ode.effects import ode_effects, plant_of
from diffsim.systems.ode.keys import (
    AnyQuantity,
    Events,
    Formula,
    FormulaKeys,
    Input,
    Inputs,
    Place,
    States,
    Store,
    Swing,
    read_names_as_text,
)
from diffsim.systems.ode.law_port import OdeLaws
from diffsim.systems.ode.library import library_of
from diffsim.systems.ode.mends import PARTS
from diffsim.systems.ode.names import RESTS, Reader, longest, rests_of, where_of
from diffsim.systems.ode.reading import LONGEST, read_system
from diffsim.systems.ode.refresh_effects import REFRESH, refresh_periods
from diffsim.systems.ode.repeat import MOST_REPEATS, write_out
from diffsim.systems.ode.thinning import INTERVAL, interval_of, simulated
from diffsim.systems.ode.unknown import unknown_forces
from diffsim.systems.quantities import Time

MOST_ROWS = 40_000  # a first answer's budget is 200 simulations of them
SLOW = (
    "{} rows are simulated one by one, as commands move from row to row: use a window or each n-th "
    "(until_s, every) to save time"
)


class OdeDescription(FormulaKeys):
    """States with rates, driven by inputs, read by formulas; everything in SI units."""

    commands_have_gradients = True
    takes_before = True

    system: Literal["ode"] = Field("ode", description="Kind of system: `ode`")
    states: States = Field(
        description="Start value of every state: a number with unit, a formula of parameters and "
        "first_CHANNEL, whose noise is fitted, or a quantity with a prior"
    )
    rates: dict[str, Formula] = Field({}, description="Rate of every state, its derivative in time")
    function: Annotated[str, PathWords("text", NAMED_CODE)] | None = Field(
        None,
        description="FILE.py:NAME instead of rates: a Python function of states, inputs and "
        "parameters, by the names of its arguments, that returns the rates by state. It is run, "
        "once, only where the command line says so: --setup FILE.py",
    )
    repeat: dict[str, Annotated[int, Field(ge=1, le=MOST_REPEATS)]] = Field(
        {},
        description="Entries of names with {k} in them are written once for all of a row: {k: 5} "
        "makes five, and in them {k}, {k-1}, {k+1} are numbers; a list has an item for each",
    )
    inputs: Inputs = Field((), description="What drives the system: commands, or formulas of them")
    limits: dict[str, tuple[float, float]] = Field(
        {}, description="Lower and upper limit of states that have some"
    )
    places: tuple[Place, ...] = Field((), description="Where forces may act; opens their effects")
    stores: tuple[Store, ...] = Field((), description="What fills and empties; opens leaks")
    events: tuple[Events, ...] = Field(
        (), description="What may have acted for a limited time; opens its forms at each place"
    )
    swings: tuple[Swing, ...] = Field(
        (),
        description="What may swing in each run with a period of its own; where, and how fast, is "
        "read off the record and fitted, with a value for every run",
    )
    time_step: Seconds | None = Field(
        None,
        gt=0,
        description="Longest step of the integrator [s]; none: the sample interval, "
        "divided until the equations are stable",
    )
    most_rows: int = Field(
        MOST_ROWS,
        ge=1000,
        description="Rows of all runs to fit and to select by that are simulated: of more, only "
        "each n-th, jumps of commands and what moves fast, in test runs too; the page says so",
    )
    slow_time: AnyQuantity | None = Field(
        None, description="Time in which slow shares of inputs and forces come; none: fitted"
    )
    clocks: dict[str, Time] = Field({}, description=CLOCKS)

    _write_out = model_validator(mode="before")(write_out)
    _read_state_names = field_validator("states", "rates", mode="before")(read_names_as_text)

    @model_validator(mode="after")
    def _check_one_way(self) -> OdeDescription:
        if bool(self.rates) == (self.function is not None):
            raise ValueError("give rates, or function: FILE.py:NAME instead of them")
        return self

    def problems(self, study: Study) -> list[Problem]:
        """Mistakes in names, formulas and units, found without a simulation."""
        if self.function is not None:
            return [Problem("warning", f"{where_of(study)}.function", self._say_not_run())]
        inputs, study = simulated(self.inputs, study, interval_of(study, self.most_rows))
        reader = Reader(study)
        self._read_model(inputs, study, reader)
        kept = sum(len(run.time_s) for run in study.runs if run.use != "test")
        if kept > 2 * self.most_rows:
            reader.problems.append(Problem("warning", "study", SLOW.format(kept)))
        return sorted(reader.problems, key=lambda p: p.severity == "note")

    def _say_not_run(self) -> str:
        file = str(self.function).partition(":")[0]
        return f"{self.function} is code, which is not run unless you say so: --setup {file}"

    def _read_model(self, inputs: tuple[Input, ...], study: Study, reader: Reader) -> FormulaSystem:
        return read_system(self, inputs, DescribedMotion.of(self, study), study, reader)

    def setup(self, study: Study) -> DiagnosisSetup:
        """Model, candidate causes and options for a study."""
        if self.function is not None:
            raise ValueError(f"{where_of(study)}.function: {self._say_not_run()}")
        periods = refresh_periods(study, self.effects.only)
        interval = interval_of(study, self.most_rows)
        inputs, used = simulated(self.inputs, study, interval)
        reader = Reader(used)
        read = self._read_model(inputs, used, reader)
        reader.finish()
        library = library_of(read)
        model = library.model
        model.frame = {
            LABELS: labels_of_blocks((*self.effects.formulas, *self.laws), used),
            HELD: dict(read.held),
            PARTS: read.parts,
            LONGEST: study.frame.get(LONGEST) or longest(used.runs),
            SCALES: library.scales.saved(),
            RESTS: rests_of(used, self.rest),
            REFRESH: periods,
            INTERVAL: interval,
        }
        found = ode_effects(library, periods)
        return DiagnosisSetup(
            model,
            chosen_effects(found, self.effects, used, plant_of(library)),
            unknown_forces(library),
            settings=settings_with(DiagnosisSettings(), self.effort),
            laws=OdeLaws(
                library=library,
                model=library.model,
                study=library.study,
                whole=library.study,
                make=self.setup,
            ),
            study=None if used is study else used,
        )
