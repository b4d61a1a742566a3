"""A few numbers that tell any others from ones that are a little different."""

import dataclasses
import math
import re
import zlib
from collections.abc import Iterator, Mapping, Set
from typing import Any

import numpy as np
from torch import Tensor

SMALL = 1e-4  # of the largest value of an array: below, values count in proportion
NOTHING = 1e-12  # largest value of an array that is rounding alone
DIGITS = 4  # of a sum over values between -1 and 1
NUMBER = re.compile(r"(?<![\w.#-])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w.])")


def arrays_of(value: Any) -> Iterator[np.ndarray]:
    """All numbers of a value, in the order of its parts; a word is a number, too."""
    if isinstance(value, Tensor):
        dense = value.detach().to_dense() if value.is_sparse or value.layout else value
        yield np.atleast_1d(dense.detach().double().numpy())
    elif isinstance(value, np.ndarray) and value.dtype.kind in "bifu":
        yield np.atleast_1d(value.astype(float))
    elif isinstance(value, (bool, int, float)):
        yield np.array([float(value)])
    elif isinstance(value, str):
        yield np.array([float(zlib.crc32(value.encode()) % 9973)])
    else:
        for part in _parts(value):
            yield from arrays_of(part)


def _parts(value: Any) -> list[Any]:
    if isinstance(value, Mapping):
        return [part for key in sorted(value, key=str) for part in (str(key), value[key])]
    if isinstance(value, Set):
        return sorted(value, key=str)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        parts = [getattr(value, field.name) for field in dataclasses.fields(value)]
        # of an interval a value near zero counts by the interval's width
        return [np.array(parts)] if all(isinstance(part, float) for part in parts) else parts
    return list(value) if isinstance(value, (list, tuple)) else []


def numbers_in(text: str) -> list[float]:
    """Numbers that a text says, as far as they stand alone; their words do not matter."""
    return [float(number) for number in NUMBER.findall(text)]


def fingerprint(value: Any) -> list[float]:
    """Number of values, and two sums over them.

    Every array is taken relative to its largest value, logarithmic above a ten-thousandth of that,
    so that small values count nearly as large ones; the largest value follows as one more.
    """
    values = [part for array in arrays_of(value) for part in _leveled(array)]
    row = np.concatenate([np.zeros(0), *values])
    weights = np.cos(1.0 + np.arange(len(row)) * 1.618033988749895)
    return [len(row), round(float(np.abs(row).sum()), DIGITS), round(float(weights @ row), DIGITS)]


def _leveled(array: np.ndarray) -> list[np.ndarray]:
    flat = array.ravel()
    known = np.where(np.isfinite(flat), flat, 0.0)
    largest = float(np.abs(known).max(initial=0.0))
    if largest < NOTHING:
        known, largest = 0.0 * known, 0.0
    scaled = np.arcsinh(known / (SMALL * (largest or 1.0))) / math.asinh(1.0 / SMALL)
    unknown = np.where(np.isnan(flat), 3.0, np.sign(flat) * 2.0)
    told = np.where(np.isfinite(flat), scaled, unknown)
    return [told, np.array([math.log(largest) if largest else 0.0])]


def is_close(found: list[float], known: list[float], share: float) -> bool:
    """Whether two fingerprints are of the same numbers.

    Args:
        found: Of numbers.
        known: Of others.
        share: Of the largest value, or of a value itself, by which each may differ.
    """
    slack = 2.0 * 10.0**-DIGITS + share * (1.0 + found[0])
    return found[0] == known[0] and bool(np.abs(np.subtract(found[1:], known[1:])).max() <= slack)
