"""Systems described in ``study.yaml``: what all descriptions share.

Under ``model:`` a study describes the system that was recorded. Every kind of system has a class of
its own, a :class:`Description`, whose fields are the keys; ``systems/registry.py`` lists them. What
a key means is said once, in the field's description: the reference of all keys is written from it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import torch
from pydantic import AfterValidator, Field, PrivateAttr, model_validator
from torch import Tensor

from diffsim.causes.listing import list_causes
from diffsim.causes.own import OwnRow, own_causes
from diffsim.causes.plant import Plant
from diffsim.causes.ports import SESSIONS
from diffsim.causes.scales import HELD, SCALES
from diffsim.core.check import as_spelled, did_you_mean
from diffsim.core.checked import checked
from diffsim.core.errors import Mistakes
from diffsim.core.schema import Part, UnitReader
from diffsim.core.units import after_number, in_unit
from diffsim.data.study import Run, Study
from diffsim.data.study_check import Problem
from diffsim.identify.effect import Effect
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.model import Parameter, SimModel
from diffsim.identify.setup import DiagnosisSetup

if TYPE_CHECKING:
    from typing_extensions import Self

MAX_EFFECTS = 6  # of systems whose parts or quantities have causes of their own


class Quantity(Part):
    """A number of a description: known, or imperfectly known with a prior.

    A plain number, or text such as "3 mm", is known exactly. With ``sd`` or ``percent`` it is
    fitted, as a base parameter.
    """

    value: float = Field(description="Best guess beforehand")
    sd: float | None = Field(None, gt=0, description="Standard deviation of the prior, in the unit")
    percent: float | None = Field(
        None, gt=0, description="Standard deviation as a share of the value; fitted as a logarithm"
    )
    lower: float = Field(-math.inf, description="Lower bound")
    upper: float = Field(math.inf, description="Upper bound")
    per: str | None = Field(
        None, description="`run`, or a fact of the runs' `setup`: a value of its own for each"
    )
    unit: str = Field("-", description="Unit that the description wants; written by the schema")
    step: float = Field(
        math.inf,
        gt=0,
        description="Longest step of difference quotients, in the unit, where records have edges "
        "that move with it",
    )

    _is_usual: bool = PrivateAttr(False)

    at_most_one: ClassVar = ("sd", "percent")

    @model_validator(mode="after")
    def _check_one_width(self) -> Quantity:
        if self.percent is not None and self.value <= 0.0:
            raise ValueError(f"percent needs a value above 0, got {self.value:g}; give sd")
        if self.per is not None and not self.is_fitted:
            raise ValueError("per needs sd or percent: a value of its own is a fitted one")
        if not self.lower <= self.value <= self.upper:
            ends = f"[{self.lower:g}, {self.upper:g}]"
            unit = after_number(self.unit)
            raise ValueError(f"value must lie within {ends}{unit}, got {self.value:g}")
        return self

    @property
    def is_fitted(self) -> bool:
        """Whether it is a base parameter."""
        return self.sd is not None or self.percent is not None

    def parameter(self, name: str) -> Parameter:
        """Base parameter with this prior."""
        if self.percent is not None:
            sd, is_log = self.percent / 100.0, True
        else:
            assert self.sd is not None
            sd, is_log = self.sd, False
        ends = (self.lower, self.upper, self.step)
        is_usual = self._is_usual
        return Parameter(name, self.value, sd, self.unit, is_log, *ends, is_usual=is_usual)

    def as_usual(self) -> Quantity:
        """The same as nobody stated it: no data sheet can be wrong about it."""
        usual = self.model_copy()
        usual._is_usual = True
        return usual


IN_UNIT = ("value", "sd", "lower", "upper")


def quantity(unit: str) -> Any:
    """Type of a key that is a :class:`Quantity` in a unit, as kinds of other packages have it."""
    return Annotated[Quantity, quantity_in(unit)]


def quantity_in(unit: str) -> UnitReader:
    """A :class:`Quantity` in a unit; text with another unit is converted.

    Args:
        unit: SI unit of the key, "-" if none.
    """

    def read(given: Any) -> Any:
        if isinstance(given, Quantity):
            return given
        if not isinstance(given, Mapping):
            return Quantity(value=in_unit(given, unit), unit=unit)
        own = str(given.get("unit", unit))
        numbers = {
            k: in_unit(
                f"{v} {own}" if isinstance(v, (int, float)) and own != "-" else v,
                unit,
                difference=k == "sd",
            )
            for k, v in given.items()
            if k in IN_UNIT
        }
        return {**given, **numbers, "unit": unit}

    return UnitReader("quantity" if unit == "-" else f"quantity in {unit}", read)


def _require_above_zero(given: Quantity) -> Quantity:
    if given.value <= 0.0:
        raise ValueError(f"value must be above 0, got {given.value:g}")
    return given


ABOVE_ZERO = AfterValidator(_require_above_zero)  # of a quantity such as a mass


def unstated_facts(quantities: Mapping[str, Quantity], runs: Sequence[Run]) -> Iterator[Problem]:
    """Quantities that differ by a fact of the runs which some of these do not state."""
    for key, q in quantities.items():
        if q.per not in (None, "run") and any(q.per not in r.setup for r in runs):
            yield Problem(
                "error", f"model: {key}", f"is stated per {q.per}, which not all runs state"
            )


def missing_commands(
    wanted: Iterable[tuple[str, str | None]], runs: Sequence[Run]
) -> Iterator[Problem]:
    """Commands that a description names and a run lacks; each is said of the first such run.

    Args:
        wanted: Keys that name a command each, and that; None: the key names none.
    """
    for key, name in wanted:
        run = next((r for r in runs if name is not None and name not in r.command), None)
        if run is not None:
            said = f"run {run.name} has no command {name!r}{did_you_mean(str(name), run.command)}"
            yield Problem("error", key, said)


def undescribed_channels(
    study: Study, stated: Iterable[str], is_shown: Callable[[str], bool], known: Iterable[str]
) -> Iterator[Problem]:
    """Channels that no marker shows, and keys of ``channels`` that the study lacks.

    Args:
        is_shown: Whether a description says what a channel of a name shows.
        known: Names that a misspelled channel may have meant.
    """
    names, known = [c.name for c in study.channels], list(known)
    for name in names:
        if not is_shown(name):
            said = (
                f"is not described{did_you_mean(name, known)}; say which marker and axis it shows"
            )
            yield Problem("error", f"model.channels.{name}", said)
    for name in stated:
        if name not in names:
            yield Problem("error", f"model.channels.{name}", "the study has no such channel")


def mismatched_channels(
    shown: Iterable[tuple[str, str]], study: Study, hint: str
) -> Iterator[Problem]:
    """Channels that a description names and the study lacks, and the other way about.

    Args:
        shown: Keys that name a channel each, and that.
        hint: What to do about a channel that no key names.
    """
    named, channels = list(shown), [c.name for c in study.channels]
    for key, name in named:
        if name not in channels:
            yield Problem("error", key, f"no channel {name!r}{did_you_mean(name, channels)}")
    for name in channels:
        if name not in [n for _, n in named]:
            yield Problem("error", f"channel {name}", hint)


def known(value: float, unit: str) -> Quantity:
    """A number that is known exactly, as the default of a key.

    Args:
        value: The number, in the unit.
        unit: SI unit, "-" if none.
    """
    return Quantity(value=value, unit=unit)


def quantities_of(part: Part, prefix: str = "") -> dict[str, Quantity]:
    """Quantities among a part's keys, by prefix and key."""
    found = {key: getattr(part, key) for key in type(part).model_fields}
    return {f"{prefix}{key}": q for key, q in found.items() if isinstance(q, Quantity)}


class EffectChoice(Part):
    """Which candidate causes are judged."""

    only: tuple[str, ...] | None = Field(
        None,
        description="Judge only these of the library, and your own; []: none but your own; "
        "default: all of the library",
    )
    without: tuple[str, ...] = Field((), description="Leave these out")
    typical: dict[str, float] = Field(
        {}, description="Size that would be no surprise, by name of the cause, in its unit"
    )
    own: tuple[OwnRow, ...] = Field(
        (), description="Causes of your own: of commands, readings, clocks, numbers or forces"
    )

    def holds(self, blocks: Sequence[Mapping[str, Any]]) -> bool:
        """Whether causes of these names are among those of the description."""
        return {str(b["name"]) for b in blocks} <= {block.name for block in self.own}

    def joined(self, blocks: Sequence[Mapping[str, Any]]) -> EffectChoice:
        """The choice with further causes that are written as rows, which are always judged."""
        return self._with_more(tuple(OwnRow.model_validate(dict(b)) for b in blocks))

    def _with_more(self, more: tuple[Any, ...]) -> Self:
        only = (*self.only, *(b.name for b in more)) if self.only is not None else None
        return self.model_copy(update={"own": (*self.own, *more), "only": only})


class Effort(Part):
    """How much is simulated; the defaults suit most studies."""

    max_effects: int | None = Field(
        None, ge=1, le=100, description="Largest number of causes in one set"
    )
    num_refits: int | None = Field(None, ge=1, description="Sets that are refitted per round")
    max_rounds: int | None = Field(None, ge=1, description="Moves to a better set, at most")
    scan_points: int | None = Field(
        None, ge=0, description="Sizes of causes with kinks that are tried before fits, at most"
    )
    difference_step: float | None = Field(
        None, gt=0, description="Step of difference quotients, in standard deviations of the priors"
    )
    unlisted_laws: bool = Field(
        True,
        description="Whether laws that no library holds are looked for in what is left; they take "
        "several times as long as a first answer",
    )


class Description(Part):
    """``model:`` of a study; one subclass per kind of system.

    Attributes:
        commands_have_gradients: Whether commands of a run may be tensors, with gradients.
        starts_as_shown: Whether a run without further readings starts as its first one shows.
        takes_before: Whether commands may say what they were before a run.
        advised: Effort that suits the kind of system.
    """

    names_differ: ClassVar[bool] = True
    commands_have_gradients: ClassVar[bool] = False
    starts_as_shown: ClassVar[bool] = False
    takes_before: ClassVar[bool] = False
    advised: ClassVar[DiagnosisSettings] = DiagnosisSettings()

    system: str = Field(description="Kind of system")
    effects: EffectChoice = Field(EffectChoice(), description="Which candidate causes are judged")
    effort: Effort = Field(Effort(), description="How much is simulated")

    def problems(self, study: Study) -> list[Problem]:
        """What the description and the recordings disagree on, found without a simulation.

        Args:
            study: Study with this description as its ``model``.
        """
        found = list(self.find_problems(study))
        if not any(problem.severity == "error" for problem in found):
            try:
                self.build(study)
            except (ValueError, OSError) as error:
                found.append(Problem("error", "model", str(error)))
        return found

    @checked(kinds_only=True)
    def find_problems(self, study: Study) -> Iterator[Problem]:
        """Mistakes that names and keys show; those of a kind of system are its own."""
        yield from ()

    @checked(kinds_only=True)
    def build(self, study: Study) -> object:
        """What is made without a simulation, where that alone shows further mistakes."""
        return None

    @checked(kinds_only=True)
    def require_possible(self, study: Study) -> None:
        """Refuse a study that the description disagrees with.

        Raises:
            ValueError: all errors of ``problems``.
        """
        wrong = [p for p in self.problems(study) if p.severity == "error"]
        if wrong:
            raise Mistakes([str(p) for p in wrong])

    def setup(self, study: Study) -> DiagnosisSetup:
        """Model, candidate causes and options for a study.

        Args:
            study: Study with this description as its ``model``.

        Raises:
            ValueError: errors of ``problems``.
        """
        self.require_possible(study)
        used = self.used_of(study)
        plant = self.plant(used)
        assert plant is not None
        model = self.model(used)
        sessions = {} if plant.sessions is None else {SESSIONS: list(plant.sessions.labels)}
        held = {name: between == "held" for name, between in plant.commands.items()}
        kept = {HELD: held} if plant.is_in_time and held else {}
        model.frame = {SCALES: plant.scales.saved(), **sessions, **kept}
        return DiagnosisSetup(
            model,
            chosen_effects(list_causes(plant), self.effects, used, plant),
            settings=settings_with(self.advise(), self.effort),
            study=None if used is study else used,
        )

    @checked(kinds_only=True)
    def used_of(self, study: Study) -> Study:
        """What counts of a study, such as tosses until their windows end.

        Args:
            study: Study with this description as its ``model``.
        """
        return study

    def advise(self) -> DiagnosisSettings:
        """Effort that suits what is described."""
        return self.advised

    @checked(kinds_only=True)
    def model(self, study: Study) -> SimModel:
        """The simulator as described, for all runs of a study.

        Args:
            study: Study with this description as its ``model``.
        """
        raise NotImplementedError

    def plant(self, study: Study) -> Plant | None:
        """What the system tells of itself to causes, of the library and of a user, and to laws.

        Args:
            study: Study with this description as its ``model``.

        Returns:
            None: nothing.
        """
        return None


class BaseParameters:
    """Quantities of a description by name: base parameters, and their values in a run.

    Args:
        runs: Runs of the study; ``per`` makes one parameter for each run or each fact of ``setup``.

    Attributes:
        base: Base parameters: "name", "name@run_3" per run, "name[propeller=A]" per fact.
    """

    def __init__(self, quantities: Mapping[str, Quantity], runs: Sequence[Run]):
        self.quantities = dict(quantities)
        names = dict.fromkeys(
            (key, self.name_of(key, run))
            for key, q in self.quantities.items()
            if q.is_fitted
            for run in runs
        )
        self.base = tuple(self.quantities[key].parameter(name) for key, name in names)
        self._known = {
            key: torch.tensor(q.value, dtype=torch.float64)
            for key, q in self.quantities.items()
            if not q.is_fitted
        }

    def with_further(self, more: Sequence[Parameter]) -> BaseParameters:
        """The same with base parameters that no quantity states, such as starts of pieces."""
        return self.with_priors((*self.base, *more))

    def with_priors(self, base: Sequence[Parameter]) -> BaseParameters:
        """The same quantities, with these base parameters."""
        out = BaseParameters({}, ())
        out.quantities, out.base, out._known = self.quantities, tuple(base), self._known
        return out

    def name_of(self, key: str, run: Run) -> str:
        """Name of the base parameter that a quantity has in a run.

        Raises:
            ValueError: ``per`` names a fact that the run does not state.
        """
        per = self.quantities[key].per
        if per is None:
            return key
        if per == "run":
            return f"{key}@{run.name}"
        if per not in run.setup:
            raise ValueError(
                f"{key} is stated per {per}, but run {run.name} has no {per} in its setup"
                f"{did_you_mean(per, run.setup)}"
            )
        return f"{key}[{per}={run.setup[per]}]"

    def in_run(self, values: Mapping[str, Tensor], run: Run) -> dict[str, Tensor]:
        """Value of every quantity in a run, known ones as constants.

        Args:
            values: Values of the base parameters by name, () or (K,) each.
        """
        return {
            key: values[self.name_of(key, run)] if q.is_fitted else self._known[key]
            for key, q in self.quantities.items()
        }


def fact_in(run: Run, name: str, unit: str) -> float:
    """A fact of a run in a unit, 0 where the run does not state it; "5 g" is read in kg, too.

    Args:
        run: Run whose ``setup`` has it.
        unit: SI unit that it is wanted in.

    Raises:
        ValueError: the fact is no number, or one of another quantity.
    """
    try:
        return in_unit(run.setup.get(name, 0.0), unit)
    except ValueError as error:
        raise ValueError(f"run {run.name}: setup.{name}: {error}") from None


def chosen_effects(
    library: Sequence[Effect],
    choice: EffectChoice,
    study: Study | None = None,
    plant: Plant | None = None,
) -> tuple[Effect, ...]:
    """Effects of a library as a description chooses them, and those that it adds by rows.

    Args:
        choice: The description's ``effects``.
        plant: What the system offers to rows of a user; None: nothing.

    Raises:
        ValueError: a name that the library does not have, or has twice; a row that cannot act.
    """
    own = [row for row in choice.own if isinstance(row, OwnRow)]
    if own:
        if study is None or plant is None:
            raise ValueError(
                f"effects.own: systems of this kind take no rows, such as {own[0].name!r}"
            )
        library = (*library, *own_causes(own, plant, study))
    known = [e.name for e in library]
    if repeated := sorted({name for name in known if known.count(name) > 1}):
        raise ValueError(
            f"effects.own: there is a cause {repeated[0]!r} already; give yours another name"
        )
    only = [as_spelled(name, known) for name in choice.only or ()]
    without = [as_spelled(name, known) for name in choice.without]
    typical = {as_spelled(name, known): size for name, size in choice.typical.items()}
    for key, names in (("only", only), ("without", without), ("typical", typical)):
        for name in names:
            if name not in known:
                hint = did_you_mean(name, known)
                raise ValueError(
                    f"effects.{key}: no cause {name!r}{hint}; known: {', '.join(known)}"
                )
    is_open = choice.only is None
    asked = {*only, *(row.name for row in choice.own)}
    kept = [e for e in library if (is_open or e.name in asked) and e.name not in without]
    return tuple(replace(e, typical=typical.get(e.name, e.typical)) for e in kept)


def settings_with(advised: DiagnosisSettings, effort: Effort) -> DiagnosisSettings:
    """Settings that a system advises, with what a description changes of them."""
    given = effort.model_dump(exclude_none=True, exclude={"unlisted_laws"})
    step = given.pop("difference_step", None)
    settings = replace(advised, search=replace(advised.search, **given))
    return (
        settings
        if step is None
        else replace(settings, jacobian=replace(settings.jacobian, step=step))
    )
