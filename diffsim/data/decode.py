"""How numbers of a column are coded: words that count modulo something, sign bits, numbers that
stand for nothing measured, sizes without their sign.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, PlainValidator, model_validator

from diffsim.core.arrays import Array
from diffsim.core.schema import KindWords, Part
from diffsim.data.codes import (
    from_sign_bit,
    from_twos_complement,
    unfolded,
    unwrapped,
)
from diffsim.data.study_types import Number, Positive, read_number

SAME = 1e-9  # relative: a number in a file and the one that stands for nothing


def _read_numbers(given: Any) -> tuple[float, ...]:
    return tuple(read_number(v) for v in (given if isinstance(given, (list, tuple)) else [given]))


Numbers = Annotated[
    tuple[float, ...], PlainValidator(_read_numbers), KindWords("number or list of numbers")
]


class Decode(Part):
    """How numbers of a column are coded, in the order in which it is undone."""

    missing: Numbers = Field(
        (), description="Numbers that stand for nothing measured, such as -999"
    )
    valid: tuple[Number, Number] | None = Field(
        None, description="Least and largest number that can be right; others were not measured"
    )
    repeats: Literal["drop"] | None = Field(
        None,
        description="drop: numbers equal to the one before were not measured, as of a slow sensor "
        "in rows of quick ones",
    )
    sign_bit: int | None = Field(
        None,
        ge=1,
        le=63,
        description="Bit that is the sign, counted from 0; those below are the size: 15 where "
        "0x8007 is -7",
    )
    signed: int | None = Field(
        None,
        ge=2,
        le=64,
        description="Bits of a two's complement that was read without its sign: 16, where 65535 "
        "is -1",
    )
    step: Positive | None = Field(
        None, description="Number of one count, of columns that were scaled; default: 1"
    )
    wrap: Positive | None = Field(
        None,
        description="The column counts modulo this, such as 4096 or 360: it goes on over its ends",
    )
    folded: Literal[1, -1] | None = Field(
        None,
        description="The column shows sizes without their sign, which changes where it touches 0; "
        "this is the sign of the first sample",
    )

    @model_validator(mode="after")
    def _one_sign(self) -> Decode:
        given = [n for n in ("sign_bit", "signed", "folded") if getattr(self, n) is not None]
        if len(given) > 1:
            raise ValueError(f"give one of {' and '.join(given)}")
        if self.valid is not None and not self.valid[0] < self.valid[1]:
            raise ValueError(f"valid: {self.valid[0]:g} is not below {self.valid[1]:g}")
        return self

    def __call__(self, column: Array) -> Array:
        """Numbers that a column stands for, (num_rows,); NaN where nothing was measured."""
        if not self.model_fields_set:
            return column
        values = np.array(column, dtype=np.float64)
        for number in self.missing:
            values[np.isclose(values, number, rtol=SAME, atol=0.0)] = np.nan
        if self.valid is not None:
            values[(values < self.valid[0]) | (values > self.valid[1])] = np.nan
        if self.repeats is not None:
            values[1:][np.diff(values) == 0.0] = np.nan
        one = self.step or 1.0
        if self.sign_bit is not None:
            values = from_sign_bit(values, self.sign_bit, one)
        if self.signed is not None:
            values = from_twos_complement(values, self.signed, one)
        if self.wrap is not None:
            values = unwrapped(values, self.wrap)
        if self.folded is not None:
            values = self.folded * unfolded(values)
        return values

    @property
    def words(self) -> str:
        """What it does, for messages."""
        said = {
            "missing": "{} taken for nothing measured",
            "valid": "numbers outside of {} left out",
            "repeats": "repeated numbers taken for nothing measured",
            "sign_bit": "bit {} taken for the sign",
            "signed": "read as a two's complement of {} bits",
            "wrap": "unwrapped at {:g}",
            "folded": "its sign found where it touches 0",
        }
        return ", ".join(
            text.format(_plain(value))
            for name, text in said.items()
            if (value := getattr(self, name)) not in (None, ())
        )


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return (
            f"{value[0]:g} to {value[1]:g}"
            if len(value) == 2
            else ", ".join(f"{v:g}" for v in value)
        )
    return value
