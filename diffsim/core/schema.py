"""Blocks of YAML files that users write: unknown keys are refused, units are converted.

A file is a tree of :class:`Part`; :func:`problem_lines` tells what is wrong with it, a line for
each mistake with its path in the file.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError, model_validator

from diffsim.core.check import did_you_mean
from diffsim.core.units import in_unit


class Part(BaseModel):
    """A block of a file: immutable, and a key that it does not know is an error."""

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True)

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


def number(unit: str) -> Any:
    """Type of a key that is a known number in a unit; text with another unit is converted."""
    return Annotated[float, BeforeValidator(lambda given: in_unit(given, unit))]


def problem_lines(where: str, error: ValidationError) -> list[str]:
    """One line per wrong key: path, what is wrong, what came.

    Args:
        where: What the paths begin with, such as "study.yaml: model".
        error: Refusal of a :class:`Part`.
    """
    out = []
    for one in error.errors(include_url=False):
        path = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in one["loc"])
        message = one["msg"].removeprefix("Value error, ")
        is_plain = isinstance(one["input"], (str, int, float, bool))
        came = f", got {one['input']!r}" if is_plain and "got" not in message else ""
        out.append(f"{where}{path}: {message}{came}")
    return out
