"""Words of sensors as numbers: sign bits, two's complements, counts modulo something, sizes."""

from __future__ import annotations

import numpy as np

from diffsim.core.arrays import Array


def from_sign_bit(values: Array, bit: int, one: float = 1.0) -> Array:
    """Sign and size of words whose sign is a bit of its own; what has bits above it stays."""
    top = one * 2.0**bit
    return np.where((values >= top - one / 2) & (values < 2.0 * top), top - values, values)


def from_twos_complement(values: Array, bits: int, one: float = 1.0) -> Array:
    """Signed numbers of words that were read without a sign."""
    whole = one * 2.0**bits
    return np.where(values >= whole / 2.0 - one / 2, values - whole, values)


def unwrapped(values: Array, period: float) -> Array:
    """A column that goes on over the ends of what it counts, (num_rows,); gaps stay gaps."""
    out = np.array(values, dtype=np.float64)
    there = np.isfinite(out)
    out[there] = np.unwrap(out[there], period=period)
    return out


def unfolded(values: Array) -> Array:
    """Sizes with the sign that makes them smooth, beginning with plus, (num_rows,)."""
    out = np.array(values, dtype=np.float64)
    there = np.flatnonzero(np.isfinite(out))
    x = out[there]
    if len(x) < 3:
        return out
    sign, signs = 1.0, np.ones(len(x))
    smallest = 0.1 * float(np.abs(x).max())
    for k in range(1, len(x)):
        before = signs[k - 1] * x[k - 1]
        slope = before - signs[k - 2] * x[k - 2] if k > 1 else 0.0
        if min(x[k], x[k - 1]) < smallest:
            goes_on = before + slope
            sign = 1.0 if abs(x[k] - goes_on) <= abs(-x[k] - goes_on) else -1.0
        signs[k] = sign
    out[there] = signs * x
    return out
