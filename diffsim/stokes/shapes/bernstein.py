"""Polynomials in Bernstein form on [0, 1]: coefficients on the last axis unless said otherwise."""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

_MAX_DEPTH = 26  # of bisection by sign changes: intervals of 1e-8
_NOISE = 4e-16  # coefficients below this, relative to the largest, count as zero
_MAX_STEPS = 80


@functools.cache
def binomials(degree: int) -> Tensor:
    """C(n, 0), ..., C(n, n); shared, not to be written to."""
    return torch.tensor([math.comb(degree, k) for k in range(degree + 1)], dtype=torch.float64)


def basis(t: Tensor, degree: int) -> Tensor:
    """C(n, k) t^k (1 - t)^(n - k), (..., n + 1)."""
    rising, falling = [torch.ones_like(t)], [torch.ones_like(t)]
    for _ in range(degree):
        rising.append(rising[-1] * t)
        falling.append(falling[-1] * (1.0 - t))
    products = [up * down for up, down in zip(rising, reversed(falling), strict=True)]
    return binomials(degree) * torch.stack(products, -1)


def product(a: Tensor, b: Tensor) -> Tensor:
    """Coefficients (..., m + n + 1) of the product of two polynomials."""
    m, n = a.shape[-1] - 1, b.shape[-1] - 1
    scaled_a, scaled_b = a * binomials(m), b * binomials(n)
    shape = (a[..., 0] + b[..., 0]).shape  # torch.broadcast_shapes takes 0.2 ms
    out = torch.zeros(*shape, m + n + 1, dtype=torch.float64)
    for i in range(m + 1):
        out[..., i : i + n + 1] += scaled_a[..., i : i + 1] * scaled_b
    return out / binomials(m + n)


def derivative(a: Tensor) -> Tensor:
    """Coefficients (..., n) of the derivative."""
    return (a.shape[-1] - 1) * (a[..., 1:] - a[..., :-1])


@functools.lru_cache(maxsize=256)
def restriction(degree: int, start: float, end: float) -> Tensor:
    """Matrix (n + 1, n + 1) from coefficients on [0, 1] to those on [start, end] (blossoming).

    Shared, not to be written to.
    """
    rows = []
    for k in range(degree + 1):
        row = torch.eye(degree + 1, dtype=torch.float64)
        for level in range(degree):
            t = end if level < k else start
            row = (1.0 - t) * row[:-1] + t * row[1:]
        rows.append(row[0])
    return torch.stack(rows)


def value_and_slope(a: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Values and derivatives (N,) of polynomials a (n + 1, N), n > 0, at t (N,); de Casteljau."""
    degree, s = len(a) - 1, 1.0 - t
    for _ in range(degree - 1):
        a = torch.addcmul(s * a[:-1], t, a[1:])
    return torch.addcmul(s * a[0], t, a[1]), degree * (a[1] - a[0])


def rising_roots(a: Tensor) -> tuple[Tensor, Tensor]:
    """All roots inside (0, 1) where the polynomials a (N, n + 1) go from minus to plus.

    Intervals are bisected until the coefficients change sign once (Descartes: exactly one root)
    or not at all. Roots closer than a width of 1e-8 are returned as one.

    Returns:
        Rows (M,) and roots (M,), in no particular order.
    """
    degree = a.shape[1] - 1
    left, right = restriction(degree, 0.0, 0.5), restriction(degree, 0.5, 1.0)
    noise = _NOISE * a.abs().amax(1)
    row, start = torch.arange(len(a)), torch.zeros(len(a), dtype=torch.float64)
    rows, roots = [], []
    for depth in range(_MAX_DEPTH + 1):
        if len(row) == 0:
            break
        width = 0.5**depth
        changes, first = _sign_changes(a, noise)
        one = (changes == 1) & (first < 0)
        rows.append(row[one])
        roots.append(start[one] + width * _single_root(a[one]))
        many = changes > 1
        flat = first == 0
        stuck = flat | (many if depth == _MAX_DEPTH else torch.zeros_like(many))
        rows.append(row[stuck])
        roots.append(start[stuck] + 0.5 * width)
        if depth == _MAX_DEPTH:
            break
        a, noise, row, start = a[many], noise[many], row[many], start[many]
        low, high = a @ left.T, a @ right.T
        middle = high[:, 0].abs() <= noise  # a root at the cut is in neither half
        rows.append(row[middle])
        roots.append(start[middle] + 0.5 * width)
        a, noise, row = torch.cat([low, high]), noise.repeat(2), row.repeat(2)
        start = torch.cat([start, start + 0.5 * width])
    return torch.cat(rows), torch.cat(roots)


def _sign_changes(a: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Number of sign changes and first sign that is not zero (0 where all are)."""
    sign = torch.where(a.abs() <= noise[:, None], 0.0, a.sign())
    last = torch.zeros(len(a), dtype=torch.float64)
    first, changes = last.clone(), torch.zeros(len(a), dtype=torch.int64)
    for k in range(a.shape[1]):
        s = sign[:, k]
        changes += s * last < 0
        first = torch.where(first == 0, s, first)
        last = torch.where(s == 0, last, s)
    return changes, first


def _single_root(a: Tensor) -> Tensor:
    """The root of polynomials that rise through zero once in [0, 1]: Newton within a bracket."""
    root = torch.full((len(a),), 0.5, dtype=torch.float64)
    a, t, index = a.T.contiguous(), root, torch.arange(len(root))
    low, high = torch.zeros_like(t), torch.ones_like(t)
    for _ in range(_MAX_STEPS):
        if len(index) == 0:
            break
        value, slope = value_and_slope(a, t)
        low = torch.where(value <= 0, t, low)
        high = torch.where(value >= 0, t, high)
        step = t - value / torch.where(slope == 0, 1.0, slope)
        # Ends included: a step that moves no more has arrived, and must not be thrown back.
        inside = (slope > 0) & (step >= low) & (step <= high)
        new = torch.where(inside, step, 0.5 * (low + high))
        going = torch.nonzero((new - t).abs() > 4e-16)[:, 0]
        root[index] = new
        index, t, a = index[going], new[going], a[:, going]
        low, high = low[going], high[going]
    return root
