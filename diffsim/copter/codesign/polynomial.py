"""Polynomials of several variables fitted to samples: fast copies of smooth exact functions."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import comb

import numpy as np

from diffsim.core.arrays import Array, IntArray

RTOL = 1e-9  # relative to the values: a polynomial that misses by more is not the function
_MOST_TERMS = 500
_OVERSAMPLED = 1.5


@dataclass(frozen=True)
class Polynomial:
    """y(s) = sum_k coefficients[:, k] prod_i ((s - origin) / scale)_i^exponents[k, i]."""

    # origin, scale: (p,) and ()
    origin: Array
    scale: float
    exponents: IntArray  # (num_terms, p)
    coefficients: Array  # (num_values, num_terms)

    def at(self, s: Array) -> tuple[Array, Array]:
        """Values (num_values,) and Jacobian (num_values, p)."""
        z = (s - self.origin) / self.scale
        slopes = [self._terms(z, {i: 1}) for i in range(len(z))]
        jacobian = self.coefficients @ np.array(slopes).reshape(len(z), -1).T / self.scale
        return self.coefficients @ self._terms(z, {}), jacobian

    def hessian(self, s: Array, weights: Array) -> Array:
        """Hessian of weights . y, (p, p)."""
        z = (s - self.origin) / self.scale
        mixed = weights @ self.coefficients
        out = np.zeros((len(z), len(z)))
        for i, j in itertools.combinations_with_replacement(range(len(z)), 2):
            orders = {i: 2} if i == j else {i: 1, j: 1}
            out[i, j] = out[j, i] = mixed @ self._terms(z, orders) / self.scale**2
        return out

    def _terms(self, z: Array, orders: dict[int, int]) -> Array:
        """Monomials, differentiated ``orders[i]`` times by variable i, (num_terms,)."""
        exponents, factor = self.exponents, np.ones(len(self.exponents))
        if orders:
            exponents = exponents.copy()
            for i, order in orders.items():
                for _ in range(order):
                    factor = factor * exponents[:, i]
                    exponents[:, i] = np.maximum(exponents[:, i] - 1, 0)
        return factor * np.prod(z**exponents, axis=1)


def fit(
    function: Callable[[Array], Array], points: Iterator[Array], origin: Array, scale: float
) -> Polynomial | None:
    """The polynomial of degree 2, 3 or 4 that a function is, or None.

    Args:
        function: (p,) to (num_values,).
        points: Endless sample points, spread over the domain of the polynomial.
        origin, scale: Origin and scale of the variables.
    """
    p = len(origin)
    inputs: list[Array] = [origin]
    outputs: list[Array] = [function(origin)]
    for degree in (2, 3, 4):
        num_terms = comb(p + degree, degree)
        if num_terms > _MOST_TERMS:
            return None
        while len(inputs) < _OVERSAMPLED * num_terms + 3:
            inputs.append(next(points))
            outputs.append(function(inputs[-1]))
        fit = _least_squares(np.array(inputs), np.array(outputs), origin, scale, degree)
        if fit is not None:
            return fit
    return None


def _least_squares(
    inputs: Array, outputs: Array, origin: Array, scale: float, degree: int
) -> Polynomial | None:
    powers = itertools.product(range(degree + 1), repeat=len(origin))
    exponents = np.array([e for e in powers if sum(e) <= degree], dtype=np.int64)
    exponents = exponents.reshape(-1, len(origin))
    z = (inputs - origin) / scale
    rows = np.prod(z[:, None, :] ** exponents, axis=2)
    size = np.abs(outputs).max(0) + 1e-300
    coefficients, _, rank, _ = np.linalg.lstsq(rows, outputs / size, rcond=None)
    # samples on a flat (no room across) leave the rest undetermined, and the fit worthless there
    if rank < len(exponents) or np.abs(rows @ coefficients - outputs / size).max() > RTOL:
        return None
    keep = np.abs(coefficients).max(1) > 1e-13
    return Polynomial(origin, scale, exponents[keep], (coefficients[keep] * size).T)
