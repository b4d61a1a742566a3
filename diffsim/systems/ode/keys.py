"""Keys of ``model: {system: ode}``, block by block; what they mean stands in each key."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    Tag,
    field_validator,
    model_validator,
)

from diffsim.causes.own import OwnRow
from diffsim.causes.row import SizeWords
from diffsim.core.expression import parse_expression
from diffsim.core.schema import Names, Part, standing_alone
from diffsim.core.units import NO_UNIT, factor, in_si
from diffsim.identify.effect import KINDS
from diffsim.systems.description import IN_UNIT, Description, EffectChoice, Quantity


def _check_formula(text: str) -> str:
    try:
        parse_expression(text)
    except ValueError as error:
        cut = text.count("(") > text.count(")")  # YAML ends text in { } and [ ] at a comma
        raise ValueError(f"{error}; in {{ }} put formulas in quotes" if cut else error) from None
    return text


#: A formula: its spelling is checked here, its names where the study is known.
def read_names_as_text(given: Any) -> Any:
    """A mapping with names as text: YAML reads some names, such as 1 or on, as something else."""
    return {str(k): v for k, v in given.items()} if isinstance(given, Mapping) else given


Formula = Annotated[str, BeforeValidator(str), AfterValidator(_check_formula)]


def _read_quantity(given: Any) -> Any:
    """A number with whatever unit it has, in SI."""
    if isinstance(given, Quantity):
        return given
    if not isinstance(given, Mapping):
        value, unit = in_si(given)
        return Quantity(value=value, unit=unit)
    own = str(given.get("unit", "-"))
    units = [in_si(given[k], own)[1] for k in IN_UNIT if k in given]
    unit = next(iter(units), own)
    for other in (*units, own):
        if NO_UNIT not in (unit, other):
            factor(other, unit)  # refuses a unit of another quantity
    return {
        **given,
        **{k: in_si(v, own, difference=k == "sd")[0] for k, v in given.items() if k in IN_UNIT},
    } | {"unit": unit}


#: A quantity in any unit.
AnyQuantity = Annotated[Quantity, BeforeValidator(_read_quantity)]


def _read_start(given: Any) -> Any:
    """A quantity where it has a prior or a unit, else a formula."""
    if isinstance(given, (Quantity, Mapping)):
        return _read_quantity(given)
    try:
        parse_expression(str(given))
    except ValueError:
        return _read_quantity(given)
    return str(given)


class Input(Part):
    """What drives the system."""

    name: str = Field(description="Name in formulas")
    formula: Formula | None = Field(
        None,
        description="Formula of commands, parameters, facts and `t`; none: the command so named",
    )
    held: bool | None = Field(
        None,
        description="Whether it keeps its value until the next sample; else straight lines. None: "
        "held where the commands rest and jump, which `check` says, and where some run does not "
        "show it `straight_between_samples` is a cause to be judged; else straight, and "
        "`held_between_samples` is one",
    )
    delay: AnyQuantity | None = Field(
        None, description="Time by which it comes later than recorded [s]; with sd it is fitted"
    )


class Place(Part):
    """Where a force, or whatever changes a velocity, may act."""

    name: str = Field("axis", description="Name, shown where there are several")
    position: str = Field(
        description="State that is the position; of a shaft whose speed alone is recorded, one "
        "more state, with the speed as its rate"
    )
    velocity: str = Field(description="State that is the velocity; forces change its rate")
    inertia: Formula = Field(
        "1", description="What a force is divided by to give the velocity's rate: a mass, say"
    )
    force: str | None = Field(
        None,
        description="Definition or input that is the force there; forces are added to it, so that "
        "they reach every rate it stands in, as in a cart with a pendulum. None: they are added to "
        "the rate of the velocity alone",
    )
    unit: str = Field(
        "",
        description="Unit of the force: N, N m, or any text; none: N, or N m of what turns; "
        "without an inertia that of an acceleration",
    )
    position_unit: str = Field(
        "",
        description="Unit of the position; none: m, or rad where a channel reads it as an angle, "
        "or a rate has its sine",
    )
    stick_velocity: float | None = Field(
        None,
        gt=0,
        description="Velocity below which dry friction fades [unit of the velocity]; "
        "none: fitted, about 1 % of the usual velocity",
    )
    unknown_knots_per_s: float | None = Field(
        None,
        gt=0,
        description="How fast an unknown force may change; none: as fast as what is left, up to "
        "200 knots",
    )


class Store(Part):
    """Something that fills and empties: a tank, a charge, a heat."""

    name: str = Field("store", description="Name, shown where there are several")
    level: str = Field(description="State that is the level")
    area: Formula = Field("1", description="What a flow is divided by to give the level's rate")
    area_unit: str | None = Field(
        None, description="Unit of the area; none: m^2 where the level is in m, else not said"
    )
    empty: float = Field(0.0, description="Level at which nothing flows out any more")
    unit: str = Field("-", description="Unit of the level")
    into: str | None = Field(
        None,
        description="Name of the store that gets what flows out or spills over; none: it is lost",
    )
    spill_share: AnyQuantity | None = Field(
        None,
        description="Share of what spills over that reaches `into`, 0 to 1; with sd it is fitted; "
        "none: all of it",
    )


class Law(Part):
    """A definition that is a law y = f(x); opens what may be wrong with its shape."""

    name: str = Field(description="Name of the definition")
    of: Formula = Field(description="What it is a law of, x: an input or a formula")
    unit: str = Field("-", description="Unit of y")
    of_unit: str = Field("-", description="Unit of x")
    per: str | None = Field(
        None,
        description="Fact of the runs, such as propeller: sizes for each value of it, beside a "
        "common one that also holds for values that were never fitted",
    )
    sweeps: bool = Field(
        False, description="Whether x was swept up and down, so that hysteresis may be seen"
    )


Form = Literal["step", "pulse", "ramp", "half_sine", "burst", "train"]
FORMS: tuple[Form, ...] = ("step", "pulse", "ramp", "half_sine", "burst", "train")


class Events(Part):
    """What acted for a limited time; where and when is found by the diagnosis."""

    name: str = Field("event", description="Name; its times are called NAME_onset, NAME_width ...")
    at: tuple[str, ...] = Field(
        min_length=1,
        description="Where it may have entered: names of places, inputs, definitions, channels",
    )
    where: dict[str, Any] = Field(
        {}, description="Facts of the runs in which it is looked for; none: all, at one time each"
    )
    forms: tuple[Form, ...] = Field(
        FORMS, description="Forms that it may have: train is pulses in equal distances"
    )
    knots: int = Field(
        300,
        ge=20,
        le=10_000,
        description="Knots of the free force in the longest run, from which it is read",
    )


class Swing(Part):
    """What may swing in every run with a period of its own, such as a gust."""

    name: str = Field(description="Name; its numbers are NAME_sine, NAME_cosine, NAME_frequency")
    of: str = Field(description="Definition that swings")
    typical: AnyQuantity = Field(description="Amplitude that would be no surprise")


class Rest(Part):
    """Window of each run in which the system rests."""

    from_s: Formula | None = Field(
        None, description="Begin of the window: number or formula of facts [s]; none: of the run"
    )
    until_s: Formula = Field(description="End of the window: number or formula of facts [s]")


class Table(Part):
    """A measured curve: straight lines between its points, held beyond the ends."""

    of: Formula = Field(description="Formula that the curve is read at")
    at: tuple[float, ...] = Field(min_length=2, description="Places of the points, increasing")
    values: tuple[float, ...] = Field(description="Values there, equally many")

    @model_validator(mode="after")
    def _check_pairs(self) -> Table:
        if len(self.at) != len(self.values):
            raise ValueError(f"{len(self.at)} places, but {len(self.values)} values")
        if any(b <= a for a, b in zip(self.at, self.at[1:], strict=False)):
            raise ValueError("at must increase from point to point")
        return self


class OwnState(Part):
    """A state that an own effect adds."""

    rate: Formula = Field(description="Its rate")
    start: Formula = Field("0", description="Its start value")


#: Keys of causes by formulas before 1.1: the one of today, and whether it says the opposite.
OLD_KEYS = {
    "signed": ("one_sided", True),
    "smooth": ("kink", True),
    "also_looks_like": ("like", False),
}


class OwnEffect(Part):
    """A cause of your own; in its formulas ``size`` is what is fitted, 0 in the plain model."""

    name: str = Field(description="Name, in small letters with underscores")
    adds_to: str | None = Field(
        None, description="Where `term` is added: a state (its rate), definition, input or channel"
    )
    multiplies: str | None = Field(
        None, description="What `term` is a factor of, instead: 1 where size is 0"
    )
    term: Formula | None = Field(None, description="Formula of the term or factor")
    adds: dict[str, Formula] = Field(
        {}, description="Instead of `adds_to`: what is added to each of several, by their names"
    )
    changes: dict[str, Formula] = Field(
        {},
        description="New formulas instead, by name of a definition, input, parameter or channel; "
        "the name itself is the old value",
    )
    states: dict[str, OwnState] = Field({}, description="States that the effect needs")
    shapes: dict[str, AnyQuantity] = Field(
        {}, description="Further numbers of these formulas, fitted where they have a prior"
    )
    size: str = Field("size", description="Name of the size in these formulas")
    per: str | None = Field(
        None, description="Fact of the runs: a size for each value of it, beside a common one"
    )
    unit: str = Field("-", description="Unit of the size")
    typical: float = Field(gt=0, description="Size that would be no surprise")
    one_sided: bool = Field(False, description="Whether the size is never below zero")
    kink: bool = Field(False, description="Whether the response has a kink at size 0")
    scanned: bool = Field(
        False, description="Whether the typical size, up and down, is tried before a fit from zero"
    )
    family: str = Field("own", description="Effects of one family are alternatives of each other")
    kind: Literal["force", "actuator", "sensor", "material", "environment"] = Field(
        "force", description=f"Where it enters, one of {', '.join(KINDS[:-1])}"
    )
    form: str = Field("", description="What it does, in a sentence")
    words: SizeWords | None = Field(
        None,
        description="What people call it at a size: `rotor 3 lost {:.0%} of its thrust`, where {} "
        "stands for the size, {:.0%} for the size in percent",
    )
    like: Names = Field((), description="What data may not tell from it")
    price: float = Field(0.0, ge=0, description="Nats that its choice among other formulas costs")

    @model_validator(mode="before")
    @classmethod
    def _read_old_keys(cls, given: Any) -> Any:
        """Keys of before 1.1, when causes by formulas had other words than those by rows."""
        if not isinstance(given, Mapping):
            return given
        read = dict(given)
        for old, (new, is_opposite) in OLD_KEYS.items():
            if old not in read:
                continue
            if new in read:
                raise ValueError(f"{old} is the old name of {new}; give {new} alone")
            value = read.pop(old)
            if is_opposite and not isinstance(value, bool):
                raise ValueError(f"{old} must be true or false, got {value!r}")
            read[new] = not value if is_opposite else value
        return read

    @model_validator(mode="after")
    def _check_one_way(self) -> OwnEffect:
        if self.adds_to is not None and self.multiplies is not None:
            raise ValueError("give adds_to or multiplies, not both")
        has_target = self.adds_to is not None or self.multiplies is not None
        if has_target != (self.term is not None):
            raise ValueError("adds_to or multiplies needs a term, and a term one of them")
        if not has_target and not self.changes and not self.adds:
            raise ValueError("it changes nothing; give adds_to or multiplies with term, or changes")
        if both := sorted({*self.adds} & {*self.changes, self.adds_to, self.multiplies}):
            raise ValueError(f"adds and another key change {both[0]}; give one of them")
        return self


def _tell_form(given: Any) -> str:
    is_row = "at" in given if isinstance(given, Mapping) else isinstance(given, OwnRow)
    return "<row>" if is_row else "<formulas>"


AnyOwn = Annotated[
    Annotated[OwnRow, Tag("<row>")] | Annotated[OwnEffect, Tag("<formulas>")],
    Discriminator(_tell_form),
]


class OwnEffects(EffectChoice):
    """Which candidate causes are judged, and causes of your own."""

    own: tuple[AnyOwn, ...] = Field(  # type: ignore[assignment]  # rows, and formulas besides
        (), description="Causes of your own: by formulas, or as rows with `at`"
    )

    @property
    def formulas(self) -> tuple[OwnEffect, ...]:
        """Those that are written as formulas."""
        return tuple(block for block in self.own if isinstance(block, OwnEffect))

    def joined(self, blocks: Sequence[Mapping[str, Any]]) -> OwnEffects:
        """The choice with further causes that are written as formulas, which are always judged."""
        return self._with_more(tuple(OwnEffect.model_validate(dict(b)) for b in blocks))


class FormulaKeys(Description):
    """Keys that systems of formulas share."""

    parameters: dict[str, AnyQuantity] = Field(
        {}, description="Known and imperfectly known numbers by name"
    )
    define: dict[str, Formula] = Field({}, description="Named formulas that others may use")
    tables: dict[str, Table] = Field({}, description="Measured curves that formulas may use")
    readings: dict[str, Formula] = Field(description="Formula of every channel")
    ranges: dict[str, tuple[float, float]] = Field(
        {},
        description="Least and largest value that the sensor of a channel can show, in SI units; "
        "readings end there, after all causes",
    )
    laws: tuple[Law, ...] = Field(
        (), description="Definitions that are laws; opens exponents, zeros, limits, drifts of them"
    )
    effects: OwnEffects = Field(OwnEffects(), description="Which candidate causes are judged")
    rest: Rest | None = Field(
        None,
        description="Window of rest: the mean of a channel in it is rest_CHANNEL in formulas; "
        "a run that begins later states it in its `setup`",
    )

    _read_names = field_validator("define", "readings", mode="before")(read_names_as_text)


States = dict[str, Annotated[str | Quantity, BeforeValidator(_read_start)]]
Inputs = tuple[Annotated[Input, standing_alone("name", str)], ...]
