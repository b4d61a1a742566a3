"""Types of the keys of ``study.yaml``: one plain message for whatever cannot be read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, PlainValidator

from diffsim.core.check import did_you_mean
from diffsim.core.schema import KindWords
from diffsim.core.schema_paths import INSIDE, PathWords
from diffsim.core.units import in_unit, to_si
from diffsim.data.formula import require_formula
from diffsim.data.study import USES

Use = Literal["fit", "select", "test"]
Fill = Literal["hold", "linear"]
Start = Literal["start"]


def read_number(given: Any) -> float:
    """A number; YAML 1.1 reads 3e-6 (without a point) as text."""
    if isinstance(given, bool) or not isinstance(given, (int, float, str)):
        raise ValueError(f"must be a number, got {given!r}")
    try:
        value = float(given)
    except ValueError:
        raise ValueError(f"must be a number, got {given!r}") from None
    if value != value or value in (float("inf"), float("-inf")):
        raise ValueError(f"must be a finite number, got {given!r}")
    return value


def in_own_unit(entry: Any, keys: Mapping[str, str]) -> Any:
    """An entry of the file whose numbers may be texts with a unit, such as 2 mm, in its ``unit``.

    Args:
        entry: What stands in the file; all but mappings is passed on.
        keys: What each of these keys is: a value, a difference of values, or a rate.
    """
    if not isinstance(entry, Mapping):
        return entry
    texts = {k: v for k, v in entry.items() if k in keys and isinstance(v, str) and _has_unit(v)}
    own = str(entry.get("unit", ""))
    if texts and not own:
        key, value = next(iter(texts.items()))
        raise ValueError(f"{key} is {value!r}; state `unit`, the unit of the file, as well")
    per_second = "1/s" if own == "-" else f"({own})/s"
    units = {k: per_second if keys[k] == "rate" else own for k in texts}
    return {**entry, **{k: _read_in(v, k, units[k], keys[k]) for k, v in texts.items()}}


def _read_in(given: str, key: str, unit: str, what: str) -> float:
    try:
        return in_unit(given, unit, difference=what != "value")
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from None


def _has_unit(given: str) -> bool:
    try:
        float(given)
    except ValueError:
        return any(letter.isdigit() for letter in given)
    return False


def read_texts(given: Any) -> tuple[str, ...]:
    """A list of texts; a single one is a list of one, and numbers are taken as written."""
    if given is None:
        return ()
    if isinstance(given, Mapping):
        raise ValueError("must be a list, got a mapping")
    return tuple(str(v) for v in (given if isinstance(given, (list, tuple)) else [given]))


def _read_per_run(given: Any) -> float | dict[str, float]:
    if isinstance(given, Mapping):
        return {str(k): read_number(v) for k, v in given.items()}
    return read_number(given)


def _read_zero(given: Any) -> float | dict[str, float] | str:
    if given == "start":
        return "start"
    try:
        return _read_per_run(given)
    except ValueError as error:
        raise ValueError(f"{error}; or start") from None


def _read_reading(given: Any) -> float | str:
    if given == "start":
        return "start"
    try:
        return read_number(given)
    except ValueError:
        raise ValueError(f"must be start or a number, got {given!r}") from None


def _read_fill(given: Any) -> float | str:
    if given in ("hold", "linear"):
        return str(given)
    try:
        return read_number(given)
    except ValueError:
        raise ValueError(f"must be hold, linear or a number, got {given!r}") from None


def _read_every(given: Any) -> int | dict[float, int]:
    if isinstance(given, Mapping):
        return {read_number(k): _read_count(v) for k, v in given.items()}
    return _read_count(given)


def _read_count(given: Any) -> int:
    if isinstance(given, bool) or not isinstance(given, int) or given < 1:
        raise ValueError(f"must be a whole number, 1 or more, got {given!r}")
    return given


def _read_use(given: Any) -> str | dict[str, tuple[str, ...]]:
    if isinstance(given, Mapping):
        for key in given:
            _require_use(key)
        return {str(k): read_texts(v) for k, v in given.items()}
    return _require_use(given)


def _require_use(given: Any) -> str:
    if given not in USES:
        known = ", ".join(USES)
        raise ValueError(f"must be one of {known}, got {given!r}{did_you_mean(str(given), USES)}")
    return str(given)


def _read_blocks_by_use(given: Any) -> dict[str, tuple[int, ...]]:
    if not isinstance(given, Mapping):
        raise ValueError("must be a mapping of uses to pieces, such as {test: [6]}")
    return {
        _require_use(k): tuple(_read_count(n) for n in (v if isinstance(v, list) else [v]))
        for k, v in given.items()
    }


def _read_unit(given: Any) -> str:
    to_si(str(given))
    return str(given)


def _read_formula(given: Any) -> str:
    return require_formula(str(given))


def _read_value(given: Any) -> Any:
    return given if isinstance(given, str) else read_number(given)


def _read_values(given: Any) -> Any:
    listed = given if isinstance(given, (list, tuple)) else [given]
    return tuple(_read_value(v) for v in listed)


Number = Annotated[float, PlainValidator(read_number), KindWords("number")]
Positive = Annotated[float, BeforeValidator(read_number), Field(gt=0), KindWords("number above 0")]
Place = Annotated[int, BeforeValidator(_read_count), KindWords("whole number")]
Unit = Annotated[str, PlainValidator(_read_unit), KindWords("unit")]
Formula = Annotated[str, PlainValidator(_read_formula), KindWords("formula")]
Texts = Annotated[tuple[str, ...], PlainValidator(read_texts), KindWords("text or list of texts")]
Files = Annotated[
    tuple[str, ...], PlainValidator(read_texts), PathWords("text or list of texts", INSIDE)
]
PerRun = Annotated[
    float | dict[str, float],
    PlainValidator(_read_per_run),
    KindWords("number, or mapping of runs to numbers"),
]
ZeroTime = Annotated[
    Start | float | dict[str, float],
    PlainValidator(_read_zero),
    KindWords("number, `start`, or mapping of runs to numbers"),
]
Zero = Annotated[Start | float, PlainValidator(_read_reading), KindWords("number or `start`")]
FillValue = Annotated[Fill | float, PlainValidator(_read_fill), KindWords("hold, linear or number")]
Every = Annotated[
    int | dict[float, int],
    PlainValidator(_read_every),
    KindWords("whole number, or mapping of times to whole numbers"),
]
UseOfRuns = Annotated[
    Use | dict[str, tuple[str, ...]],
    PlainValidator(_read_use),
    KindWords("fit, select or test, or mapping of these to runs"),
]
UseOfBlocks = Annotated[
    dict[str, tuple[int, ...]],
    PlainValidator(_read_blocks_by_use),
    KindWords("mapping of fit, select, test to numbers of pieces"),
]
Values = Annotated[
    tuple[str | float, ...], PlainValidator(_read_values), KindWords("list of numbers or texts")
]
Value = Annotated[str | float, PlainValidator(_read_value), KindWords("number or text")]
