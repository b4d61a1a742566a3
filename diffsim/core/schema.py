"""Blocks of YAML files that users write: unknown keys are refused, units are converted.

A file is a tree of :class:`Part`; :func:`read_part` makes it of plain values and tells what is
wrong with them, a line for each mistake with its path in the file.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, ClassVar, TypeVar, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    GetCoreSchemaHandler,
    ValidationError,
    model_validator,
)
from pydantic_core import core_schema

from diffsim.core.check import did_you_mean
from diffsim.core.errors import Mistakes
from diffsim.core.units import in_unit


@dataclass(frozen=True)
class KindWords:
    """What a type of keys is called in messages to people, kept in its annotation."""

    words: str  # such as "formula" or "number in kg"


MAX_WHOLE_NUMBER = 1_000_000  # of a whole number for which its key states no other bound


class Part(BaseModel):
    """A block of a file: immutable, and a key that it does not know is an error.

    Whole numbers are counts of something that is made: beyond ``MAX_WHOLE_NUMBER`` they are
    refused.

    Attributes:
        names_differ: Whether two parts of one name in a list of it are an error.
        one_of: Keys of which one must be given, and no more.
        at_most_one: Keys of which no two may be given.
    """

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True)
    names_differ: ClassVar[bool] = False
    one_of: ClassVar[tuple[str, ...]] = ()
    at_most_one: ClassVar[tuple[str, ...]] = ()

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, given: Any) -> Any:
        if isinstance(given, Mapping):
            known = [field.alias or name for name, field in cls.model_fields.items()]
            for key in given:
                if key not in known and key not in cls.model_fields:
                    raise ValueError(
                        f"no key {key!r} here{did_you_mean(str(key), known)}; "
                        f"known: {', '.join(known)}"
                    )
        return given

    @model_validator(mode="after")
    def _check_values(self) -> Part:
        for choice in filter(None, (self.one_of, self.at_most_one)):
            stated = [key for key in choice if getattr(self, key) not in (None, ())]
            if len(stated) > 1 or (not stated and choice is self.one_of):
                said = " and ".join(stated) or "none"
                raise ValueError(f"give one of {', '.join(choice)}, got {said}")
        for key in type(self).model_fields if self.names_differ else ():
            parts = getattr(self, key)
            given = parts if isinstance(parts, tuple) else ()
            names = [part.name for part in given if hasattr(part, "name")]
            if twice := {name for name in names if names.count(name) > 1}:
                raise ValueError(f"{key}: the name {min(twice)!r} is used twice")
        for name in _counts_without_bound(type(self)):
            for count in _whole_numbers(getattr(self, name)):
                if abs(count) > MAX_WHOLE_NUMBER:
                    raise ValueError(f"{name} must be at most {MAX_WHOLE_NUMBER:,}, got {count:,}")
        return self


@cache
def _counts_without_bound(part: type[Part]) -> tuple[str, ...]:
    """Keys of a block that are whole numbers, or made of them, without a bound of their own."""
    return tuple(
        name
        for name, field in part.model_fields.items()
        if _is_of(int, field.annotation)
        and not any(getattr(m, "le", None) is not None for m in field.metadata)
    )


def _is_of(kind: type, annotation: Any) -> bool:
    return annotation is kind or any(_is_of(kind, inner) for inner in get_args(annotation))


def _whole_numbers(value: Any) -> Iterator[int]:
    """Those of a value, and of the lists and mappings that it is made of; blocks have their own."""
    if isinstance(value, int):
        yield value
    elif isinstance(value, (tuple, list)):
        for one in value:
            yield from _whole_numbers(one)
    elif isinstance(value, Mapping):
        for one in value.values():
            yield from _whole_numbers(one)


def _few_cells(counts: Any) -> Any:
    if math.prod(counts) > MAX_WHOLE_NUMBER:
        raise ValueError(f"at most {MAX_WHOLE_NUMBER:,} cells, got {' x '.join(map(str, counts))}")
    return counts


FewCells2 = Annotated[tuple[int, int], AfterValidator(_few_cells)]
FewCells3 = Annotated[tuple[int, int, int], AfterValidator(_few_cells)]


class FinitePart(Part):
    """A block in which no number may be infinite or NaN."""

    model_config = ConfigDict(allow_inf_nan=False)


_P = TypeVar("_P", bound=Part)


def read_part(part: type[_P], given: Any, where: str) -> _P:
    """A block of plain values, as ``core.yaml_text`` reads them.

    Args:
        given: What stands in the file.
        where: What the paths begin with, as in ``problem_lines``.

    Raises:
        Mistakes: a line for each.
    """
    try:
        return part.model_validate(given)
    except ValidationError as error:
        raise Mistakes(problem_lines(where, error)) from None


@dataclass(frozen=True)
class UnitReader(KindWords):
    """How a key with a unit is read; made by :func:`number` and ``quantity_in``."""

    read: Callable[[Any], Any]  # what the key holds, of what stands in the file

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        return core_schema.no_info_before_validator_function(self.read, handler(source))


def number(unit: str) -> UnitReader:
    """A known number in a unit; text with another unit is converted."""
    words = "number" if unit == "-" else f"number in {unit}"
    return UnitReader(words, lambda given: in_unit(given, unit))


def standing_alone(key: str, *kinds: type) -> BeforeValidator:
    """Reads what stands alone, such as a name, as a part that has this key and no other."""
    return BeforeValidator(lambda given: {key: given} if isinstance(given, kinds) else given)


#: Names, of which one may stand without a list.
Names = Annotated[
    tuple[str, ...], BeforeValidator(lambda given: (given,) if isinstance(given, str) else given)
]
_FIELD = re.compile(r"\{\{|\}\}|\{([^{}:!]*)(?::([^{}]*))?\}|[{}]")
_FORMAT = re.compile(r"(?:.?[<>=^])?[-+ ]?0?\d{0,2},?(?:\.\d{1,2})?[a-zA-Z%]?")


def fill_in(text: str, words: Mapping[str, Any]) -> str:
    """A text of a file with its {words} filled in; {{ and }} stand for braces.

    Python's own format would follow attributes, and write a number as wide as a file asks for.

    Args:
        text: ``{name}``, or ``{name:03d}`` with a format of at most two digits of width, and of
            places.
        words: What names stand for; "" is what ``{}`` stands for.

    Raises:
        KeyError: a name that there is not; its first argument is the name.
        ValueError: a format that is none, or wider; or a brace without its other one.
    """

    def word(found: re.Match[str]) -> str:
        if found[0] in ("{{", "}}"):
            return found[0][0]
        if found[1] is None:
            raise ValueError(f"{found[0]!r} at column {found.start() + 1} stands alone")
        stated = found[2] or ""
        if not _FORMAT.fullmatch(stated):
            raise ValueError(
                f"{stated[:20]!r} is no format of up to two digits, such as 03d or .2f"
            )
        return format(words[found[1].strip()], stated)

    return _FIELD.sub(word, text)


_PLAIN = (
    (r"Field required", "is missing"),
    (r"Input should be greater than or equal to (\S+)", r"must be at least \1"),
    (r"Input should be greater than (\S+)", r"must be above \1"),
    (r"Input should be less than or equal to (\S+)", r"must be at most \1"),
    (r"Input should be less than (\S+)", r"must be below \1"),
    (r"Input should be a valid integer.*", "must be a whole number"),
    (r"Input should be a valid number.*", "must be a number"),
    (r"Input should be a valid string", "must be text"),
    (r"Input should be a valid boolean.*", "must be true or false"),
    (r"Input should be a valid (list|tuple)", "must be a list"),
    (r"Input should be a valid dictionary.*", "must be a mapping"),
    (r"\w+ should have at least (\d+) items? after validation.*", r"must have \1 or more entries"),
    (r"\w+ should have at most (\d+) items? after validation.*", r"must have \1 or fewer entries"),
    (r"Input should be (.*)", r"must be \1"),
)
"""What pydantic says, and how people say it."""


def problem_lines(where: str, error: ValidationError) -> list[str]:
    """One line per wrong key: path, what is wrong, what came.

    Args:
        where: What the paths begin with, such as "study.yaml: model" or "study.yaml: ".
        error: Refusal of a :class:`Part`.
    """
    out = []
    errors = error.errors(include_url=False)
    for one in errors:
        if one["type"] == "too_short" and any(_is_below(e["loc"], one["loc"]) for e in errors):
            continue  # entries that are wrong are not counted
        # "<...>" tells pydantic which of several blocks is meant, and is no key
        keys = [p for p in one["loc"] if not str(p).startswith("<")]
        path = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in keys)
        path = path.removeprefix(".") if where.endswith(" ") else path
        message = one["msg"].removeprefix("Value error, ")
        for pattern, plain in _PLAIN:
            message = re.sub(f"^{pattern}", plain, message)
        if one["loc"][-1:] == ("[key]",) and isinstance(one["input"], bool):
            message += " (YAML reads on, off, yes, no so; quote it, or use another word)"
        is_plain = isinstance(one["input"], (str, int, float, bool))
        is_said = "got" in message or (is_plain and repr(one["input"]) in message)
        is_other_kind = one["type"].endswith("_type")
        shown = repr(one["input"]) if is_plain else _kind_words(one["input"]) * is_other_kind
        came = f", got {shown}" if shown and not is_said else ""
        out.append(
            f"{where}{path}: {message}{came}" if path else f"{where.rstrip(': ')}: {message}"
        )
    return out


def _kind_words(given: Any) -> str:
    """A block that stands where another kind is expected; empty: what came says nothing."""
    if given is None:
        return "nothing"
    if isinstance(given, list | tuple):
        return f"a list of {len(given)}"
    if isinstance(given, Mapping):
        return f"a mapping with {', '.join(map(str, list(given)[:3]))}" if given else "{}"
    return ""


def _is_below(path: tuple[str | int, ...], other: tuple[str | int, ...]) -> bool:
    return len(path) > len(other) and path[: len(other)] == other
