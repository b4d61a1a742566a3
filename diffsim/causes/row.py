"""One cause as data: a row of a table, by which an effect on a scene is made.

What a row says (name, family, unit, usual size, words) is said once, for every system that has the
cause and for studies that add one of their own.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, field_validator, model_validator

from diffsim.causes.needs import NEEDS
from diffsim.core.expression import parse_expression
from diffsim.core.schema import Names, Part, fill_in
from diffsim.identify.effect import Apply, Effect
from diffsim.identify.law import Shape

Port = Literal["command", "reading", "clock", "number", "force", "law", "store", "scene"]


def _for_any(given: Any) -> Any:
    return given if isinstance(given, Mapping) else {ANY: given}


def _check_words(words: str) -> str:
    try:
        fill_in(words, {"": 0.5})
    except (KeyError, ValueError) as error:
        raise ValueError(f"{words!r} cannot be filled in with a size: {error}") from None
    return words


def with_size(words: str, size: float) -> str:
    """A text of :data:`SizeWords` with a size in it; `{:.0%}` makes "16 %"."""
    return re.sub(r"(\d)%", r"\1 %", fill_in(words, {"": size}))


#: Text that a size is filled into: `{:.2g} N lost in each drive`.
SizeWords = Annotated[str, AfterValidator(_check_words)]
ANY = "any"  # kind of system, where a row says nothing of one
#: What a row says of any kind of system, and of those where it is something else.
NamesBySystem = Annotated[dict[str, Names], BeforeValidator(_for_any)]
SizeBySystem = Annotated[dict[str, float | str], BeforeValidator(_for_any)]
TextBySystem = Annotated[dict[str, str], BeforeValidator(_for_any)]
FlagBySystem = Annotated[dict[str, bool], BeforeValidator(_for_any)]


class ShapeOfRow(Part):
    """A further number of a cause, fitted beside its size; a formula as ``typical`` is."""

    value: float | str = Field(description="Best guess beforehand")
    sd: float | str = Field(description="Standard deviation of the prior")
    lower: float | str = Field(-math.inf, description="Lower bound")
    upper: float | str = Field(math.inf, description="Upper bound")
    unit: str = Field("-", description="SI unit")


class Row(Part):
    """One cause: what it is called, where and how it acts, how large it may be."""

    name: str = Field(description="Name, in small letters with underscores")
    at: Port = Field(
        description="Where it acts: on a `command` on its way to the actuators, on the `reading` "
        "or the `clock` of channels, on a `number` of the system, as a `force` at a place; on a "
        "`law` or a `store` of formulas; `scene` for what the system's own code does"
    )
    family: str = Field("own", description="Causes of one family are alternatives of each other")
    kind: Literal["force", "actuator", "sensor", "material", "environment"] = Field(
        description="Where the cause lies"
    )
    map: TextBySystem | None = Field(
        None,
        description="Of a command or reading: a map of signals (`delayed`, `lagged`, ...), or a "
        "formula of the signal u, of size and of the time t since the start; of a number: what is "
        "added, or how much larger it gets, where that is not the size itself",
    )
    add: Names = Field((), description="Numbers of the system that the size is added to")
    scale: Names = Field((), description="Numbers that become 1 + size times as large")
    law: TextBySystem | None = Field(
        None,
        description="Of a force: its formula, of size, position x, speed v and the speed w below "
        "which friction fades; of a law: the new one, of y, x and size; of a store: what it gains",
    )
    unit: str = Field("-", description="SI unit of the size; `command`: that of the command")
    shown: str | None = Field(None, description="Unit in which a user reads the size")
    typical: SizeBySystem = Field(
        description="Size that would be no surprise: a number, or a formula of usual magnitudes; "
        "by kind of system where they differ"
    )
    components: Names = Field(("size",), description="Names of the sizes, where it has several")
    one_sided: FlagBySystem = Field(
        {ANY: False}, description="Whether the size is never below zero"
    )
    kink: FlagBySystem = Field({ANY: False}, description="Whether the response has a kink at zero")
    scanned: bool = Field(False, description="Whether sizes over decades are tried before a fit")
    tries: tuple[float, ...] = Field((), description="Multiples of the usual size that are tried")
    masks: NamesBySystem = Field(
        {ANY: ()}, description="Causes that hide it, or that it hides; by kind of system"
    )
    over_time: bool = Field(
        False, description="Whether it shows only where samples follow each other in time"
    )
    when: Names = Field((), description="Facts of the system that must hold for it to be judged")
    unless: Names = Field((), description="Facts of the system that keep it from being judged")
    not_for: Names = Field((), description="Kinds of systems that have it under another name")
    each: str | None = Field(
        None,
        description="Kind of parts, such as `tendon`: a cause for each, in whose name, numbers and "
        "family `{tendon}` stands for it. Without it numbers and components that hold `{tendon}` "
        "become one for each",
    )
    per: Literal["session"] | None = Field(
        None, description="Sizes of later sessions: the first is as described"
    )
    shapes: dict[str, ShapeOfRow] = Field(
        {}, description="Further numbers that are fitted beside the size"
    )
    needs: TextBySystem | None = Field(
        None, description="What a study must have for it to be judged"
    )
    form: str = Field(
        "", description="What it does at a size, in a sentence; {reach:.3g} is a usual magnitude"
    )
    words: SizeWords | None = Field(
        None, description="What people call it at a size: `{:.2g} N lost in each drive`"
    )
    like: Names = Field((), description="What data may not tell from it")

    @field_validator("typical", "masks", "map", "law", "one_sided", "kink", "needs")
    @classmethod
    def _says_something_of_any(cls, given: dict[str, Any] | None) -> dict[str, Any] | None:
        if given is not None and ANY not in given:
            raise ValueError(f"say what holds for {ANY} kind of system, too")
        return given

    @model_validator(mode="after")
    def _acts_one_way(self) -> Row:
        keys = {
            "command": ("map",),
            "reading": ("map",),
            "number": ("add", "scale"),
            **dict.fromkeys(("force", "law", "store"), ("law",)),
        }
        wanted = keys.get(self.at, ())
        may = ("map",) if self.at == "number" else ()
        keys_of_acts = ("map", "add", "scale", "law")
        stated = [key for key in keys_of_acts if key not in may and getattr(self, key)]
        if wanted and len(stated) != 1:
            raise ValueError(f"a cause at a {self.at} is stated by {' or '.join(wanted)} alone")
        if wrong := [key for key in stated if key not in wanted]:
            raise ValueError(f"a cause at a {self.at} has no {wrong[0]}")
        numbers = self.add or self.scale
        if len(numbers) % len(self.components):
            raise ValueError(
                f"{len(numbers)} numbers cannot share {len(self.components)} sizes evenly"
            )
        for said in (self.needs or {}).values():
            if said not in NEEDS:
                raise ValueError(f"needs must be one of {', '.join(NEEDS)}, got {said!r}")
        if self.per is not None and self.at != "number":
            raise ValueError(f"a cause at a {self.at} is not stated per {self.per}")
        return self

    def of_parts(self, parts: Mapping[str, Mapping[str, str]]) -> Iterator[tuple[str, Row]]:
        """The row for the parts of a system, with what its name ends with.

        Args:
            parts: Of each kind of parts their names, and what stands for them in names of numbers.

        Yields:
            One of each part where the row says ``each``, else one of all; none where there are no
            parts of a kind that it names.
        """
        if self.each is None:
            if all(kind in parts for kind in self._kinds_of_parts()):
                yield "", self._filled_in(parts)
            return
        for name, number in parts.get(self.each, {}).items():
            filled = self._filled_in({**parts, self.each: {name: number}})
            family = self.family.replace(f"{{{self.each}}}", name)
            yield f"_{name}", filled.model_copy(update={"family": family})

    def _kinds_of_parts(self) -> set[str]:
        texts = (*self.add, *self.scale, *self.components)
        return {kind for text in texts for kind in _PLACE_OF_PART.findall(text)}

    def _filled_in(self, parts: Mapping[str, Mapping[str, str]]) -> Row:
        """The row with parts in place of their kinds, numbers by theirs, components by names."""
        if not self._kinds_of_parts():
            return self
        numbers = {kind: tuple(of.values()) for kind, of in parts.items()}
        names = {kind: tuple(of) for kind, of in parts.items()}
        filled: dict[str, Names] = {
            "add": _fill_in(self.add, numbers),
            "scale": _fill_in(self.scale, numbers),
            "components": _fill_in(self.components, names),
        }
        return self.model_copy(update=filled)

    def said(self, key: str, system: str = ANY) -> Any:
        """What the row says of a kind of system under a key that may differ between these.

        Args:
            key: ``map``, ``law``, ``typical``, ``masks``, ``one_sided``, ``kink`` or ``needs``.
            system: Kind of system.
        """
        stated: Mapping[str, Any] = getattr(self, key) or {ANY: None}
        return stated.get(system, stated[ANY])

    def shapes_in(self, scales: Mapping[str, float], cause: str) -> dict[str, Shape]:
        """Further numbers with their priors, by name of the base parameter that each is.

        Args:
            scales: Usual magnitudes by the names that formulas may use.
            cause: Name of the cause.
        """
        return {
            f"{name}_of_{cause}": Shape(
                number_in(s.value, scales),
                number_in(s.sd, scales),
                s.unit,
                number_in(s.lower, scales),
                number_in(s.upper, scales),
            )
            for name, s in self.shapes.items()
        }

    def effect(
        self,
        apply: Apply,
        scales: Mapping[str, float] | None = None,
        *,
        system: str = ANY,
        ending: str = "",
        **own: Any,
    ) -> Effect:
        """The cause as it acts on the scenes of one system.

        Args:
            apply: Function (scene, size, run) -> scene, as of :class:`Effect`.
            scales: Usual magnitudes that ``typical`` and ``form`` may use.
            system: Kind of system.
            ending: What the name ends with, such as "_of_motor".
            **own: Fields of the effect that differ in this system, such as its components.
        """
        known = dict(scales or {})
        stated: dict[str, Any] = {
            "name": self.name + ending,
            "family": self.family,
            "kind": self.kind,
            "unit": self.unit,
            "shown_unit": self.shown,
            "components": self.components,
            "signed": not self.said("one_sided", system),
            "smooth": not self.said("kink", system),
            "scanned": self.scanned,
            "tries": self.tries,
            "masks": tuple(m + ending for m in self.said("masks", system)),
            "also_looks_like": self.like,
            "words": None if self.words is None else partial(with_size, self.words),
            "needs": NEEDS[self.said("needs", system) or "nothing"],
        }
        if "typical" not in own:
            own["typical"] = number_in(self.said("typical", system), known)
        if self.shapes and "shapes" not in own:
            own["shapes"] = self.shapes_in(known, self.name + ending)
        if "form" not in own:
            own["form"] = fill_in(self.form, known)
        return Effect(apply=apply, **{**stated, **own})


def number_in(stated: float | str, scales: Mapping[str, float]) -> float:
    """A number, or the value of a formula of usual magnitudes.

    Args:
        scales: Usual magnitudes by the names that it may use.

    Raises:
        ValueError: it uses a name that there is not.
    """
    if not isinstance(stated, str):
        return float(stated)
    formula = parse_expression(stated, tuple(scales))
    return float(formula.on_floats(*scales)(*scales.values()))


_PLACE_OF_PART = re.compile(r"\{(\w+)\}")


def _fill_in(texts: Names, parts: Mapping[str, tuple[str, ...]]) -> Names:
    """Each text, or one of each part of the kind that it holds in braces."""
    out: list[str] = []
    for text in texts:
        kinds = _PLACE_OF_PART.findall(text)
        out += [text.replace(f"{{{kinds[0]}}}", p) for p in parts[kinds[0]]] if kinds else [text]
    return tuple(out)


def spell_plainly(name: str) -> str:
    """A name as the names of causes are written: letters as they are, digits, underscores."""
    kept = "".join(c if c.isalnum() and c.isascii() else "_" for c in name)
    return kept.strip("_") or "x"
