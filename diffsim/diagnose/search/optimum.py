"""Quadratic misfit with the prior of base parameters (normal) and sizes (heavy-tailed); no
simulation.

All in scaled coordinates v: the misfit is v'Gv - 2 b'v + const, the prior |q|^2 of base parameters
and x(u)^2 of sizes (``identify.effect``).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

from diffsim.identify.effect import TAIL, coordinate_of, precision_at, scaled_at
from diffsim.identify.gaussian import Gaussian
from diffsim.identify.whitening import MIN_SPARSE

Array = NDArray[np.float64]
REWEIGHT_TOLERANCE = 1e-7  # of a coordinate, relative above one
FREE = 1e-6  # precision of a size that is nearly without a prior
ROUNDING = 1e-13
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)
_PANELS = np.linspace(-10.0, 10.0, 41)
_NEAR_ZERO = np.geomspace(1e-7, 1.0, 15)
_PEAK = np.arange(-9.0, 10.0)


def optimum(
    gram: Array, b: Array, low: Array, high: Array, sizes: NDArray[np.bool_], start: Array
) -> Array:
    """argmin v'Gv - 2 b'v + |q|^2 + |x(u)|^2 within bounds, by reweighted least squares.

    The prior may make two valleys: one near small sizes, one where the misfit alone is least. Both
    are followed, and the lower end is taken.

    Args:
        gram, b: Quadratic and linear part of the misfit, (n, n) and (n,).
        low, high: Bounds, (n,).
        sizes: Whether a coordinate is a scaled size, (n,) bool.
        start: Scaled coordinates that give the first weights, (n,).
    """
    gram = kept_definite(gram)
    if not sizes.any():
        return quadratic_optimum(gram + np.eye(len(b)), b, low, high)
    if sizes.all():
        return _sizes_optimum(gram, b, low, high, start)
    # base parameters at their best for any others, as long as they are not at a bound
    v, kept = np.zeros(len(b)), sizes
    while True:
        base = ~kept
        at_best = Gaussian(gram[np.ix_(base, base)] + np.eye(int(base.sum())), b[base])
        outer = gram[np.ix_(base, kept)]
        own = at_best.left_to(outer, gram[np.ix_(kept, kept)], b[kept])
        near, far = low[kept], high[kept]
        if kept is sizes:
            v[kept] = _sizes_optimum(*own, near, far, start[kept])
        else:
            first = np.ones(int(kept.sum()))
            first[sizes[kept]] = precision_at(v[sizes])
            v[kept] = _reweight_sizes(*own, near, far, sizes[kept], first)
        v[base] = at_best.mean - at_best.solve(outer @ v[kept])
        beyond = base & ((v < low) | (v > high))
        if not beyond.any():
            return v
        # of few coordinates all, which takes one more round at most
        kept = kept | beyond if len(b) >= MIN_SPARSE else np.ones(len(b), dtype=bool)


def kept_definite(gram: Array) -> Array:
    """A Gram matrix whose rounding cannot make it indefinite: columns that others make up leave
    differences of large numbers, and a size far out has hardly a prior to add."""
    return gram + np.diag(ROUNDING * np.diag(gram))


def _sizes_optimum(gram: Array, b: Array, low: Array, high: Array, start: Array) -> Array:
    """The optimum where all coordinates are sizes: the lower end of two valleys."""
    every = np.ones(len(b), dtype=bool)
    near = _reweight_sizes(gram, b, low, high, every, precision_at(start))
    free = quadratic_optimum(gram + FREE * np.eye(len(b)), b, low, high)
    far = _reweight_sizes(gram, b, low, high, every, precision_at(free))
    return min(near, far, key=lambda u: _cost(u, gram, b, every))


def _reweight_sizes(
    gram: Array, b: Array, low: Array, high: Array, sizes: NDArray[np.bool_], weights: Array
) -> Array:
    """Least squares, reweighted until the sizes stand; Newton's steps where the prior's penalty is
    convex, as long as they lead down."""
    weights = weights.copy()

    v, here = np.full(len(b), np.nan), np.inf
    for step in range(60):
        after, there = v, np.inf
        if step >= 2:  # safe ones come before Newton's
            curvature, push = np.ones(len(b)), np.zeros(len(b))
            curvature[sizes], push[sizes] = _newton(v[sizes], weights[sizes])
            after = quadratic_optimum(_with_prior(gram, curvature), b + push, low, high, v)
            there = _cost(after, gram, b, sizes)
        if not there < here:
            after = quadratic_optimum(_with_prior(gram, weights), b, low, high, v)
            there = _cost(after, gram, b, sizes)
        close = REWEIGHT_TOLERANCE * np.maximum(np.abs(after), 1.0)
        is_end = bool(np.all(np.abs(after - v) <= close))
        v, here = after, there
        if is_end:
            break
        weights[sizes] = precision_at(v[sizes])
    return v


def _with_prior(gram: Array, precision: Array) -> Array:
    """The Gram matrix with a precision of every coordinate on its diagonal."""
    out = gram.copy()
    np.einsum("ii->i", out)[:] += precision
    return out


def _cost(v: Array, gram: Array, b: Array, sizes: NDArray[np.bool_]) -> float:
    """Misfit and prior at v, but for a constant."""
    x = coordinate_of(v[sizes])
    return float(v @ gram @ v - 2.0 * b @ v + v[~sizes] @ v[~sizes] + x @ x)


def _newton(u: Array, weights: Array) -> tuple[Array, Array]:
    """Curvature of x(u)^2 / 2 and what its slope pushes beyond that; the weights where concave."""
    x, root = coordinate_of(u), np.sqrt(1.0 + (TAIL * u) ** 2)
    curvature = 1.0 / root**2 - x * TAIL**2 * u / root**3
    is_convex = curvature > 0.1 * weights
    push = np.where(is_convex, curvature * u - x / root, 0.0)
    return np.where(is_convex, curvature, weights), push


def quadratic_optimum(
    hessian: Array, b: Array, low: Array, high: Array, near: Array | None = None
) -> Array:
    """argmin v'Hv - 2 b'v within bounds, by active sets; H must be positive definite.

    Args:
        hessian, b: H and b, (n, n) and (n,).
        low, high: Bounds, (n,).
        near: Where a problem like it has its optimum, (n,): which bounds hold there is tried first.
    """
    if not len(b):
        return np.zeros(0)
    active = np.zeros(len(b), dtype=int)  # -1: at the lower bound, 1: at the upper
    if near is not None:
        active = (near >= high).astype(int) - (near <= low).astype(int)
    for _ in range(3 * len(b) + 3):
        free = active == 0
        if free.all():
            v = _solve_step(hessian, b)
        else:
            v = np.where(active < 0, low, high)
            own, held = np.flatnonzero(free), np.flatnonzero(~free)
            if len(own):
                right = b[own] - hessian[own[:, None], held] @ v[held]
                v[own] = _solve_step(hessian[own[:, None], own], right)
        below, above = free & (v < low), free & (v > high)
        if below.any() or above.any():
            active = active - below + above
            continue
        if free.all():
            return v
        inward = active * (hessian @ v - b)  # above 0: the misfit falls off the bound
        if (worst := int(np.argmax(inward))) >= 0 and inward[worst] > 1e-12 * (1.0 + abs(b[worst])):
            active[worst] = 0
            continue
        return v
    return _bounded_least_squares(hessian, b, low, high)


def log_tilt(mean: float, sd: float, precision: float, signed: bool) -> float:
    """ln of what the heavy-tailed prior of a size makes of the evidence under its normal stand-in.

    The normal stand-in N(0, 1 / precision) is taken out of the posterior N(mean, sd^2), and the
    true prior is put in: ln of the ratio of both integrals. Exact for one size in a problem that is
    linear in the sizes; with several, each is integrated with the others at their stand-ins.

    Args:
        mean, sd: Posterior under the stand-in, without bounds, in units of the stand-in's sd.
        precision: Of the stand-in, in scaled sizes.
        signed: Whether the size may be negative; else twice the prior above zero.
    """
    width = 1.0 / np.sqrt(precision)
    curvature = max(1.0 / sd**2 - 1.0, 0.0) / width**2  # of the likelihood alone
    slope = mean / sd**2 / width
    edges = _PANELS
    if curvature * width**2 > 1e-10:
        place = (slope + np.sqrt(curvature) * _PEAK) / curvature
        edges = np.concatenate([edges, coordinate_of(place)])
    if not signed:
        edges = np.concatenate([np.clip(edges, 0.0, None), _NEAR_ZERO])
    edges = np.unique(edges)
    half = 0.5 * np.diff(edges)[:, None]
    x = (edges[:-1, None] + half) + half * _NODES
    u = scaled_at(x)
    logs = slope * u - 0.5 * curvature * u * u - 0.5 * x * x - 0.5 * np.log(2.0 * np.pi)
    top = float(logs.max())
    area = float(np.sum(np.exp(logs - top) * half * _WEIGHTS)) * (1.0 if signed else 2.0)
    return top + float(np.log(area)) - float(np.log(sd)) - 0.5 * (mean / sd) ** 2


def _bounded_least_squares(hessian: Array, b: Array, low: Array, high: Array) -> Array:
    """The same where active sets go round in a circle; directions that rounding has left without
    curvature, or with less than none, get as little as it is good for."""
    unit, scaled = _to_unit_diagonal(hessian)
    values, vectors = linalg.eigh(scaled)
    roots = np.sqrt(np.maximum(values, ROUNDING * values[-1]))
    right = (vectors.T @ (unit * b)) / roots
    within = low / unit, high / unit
    found = optimize.lsq_linear(roots[:, None] * vectors.T, right, within, method="bvls")
    return np.asarray(unit * found.x)


def _to_unit_diagonal(hessian: Array) -> tuple[Array, Array]:
    """Units of coordinates, (n,), and the matrix in them: sizes that nothing shows differ by many
    decades."""
    root = np.sqrt(np.diagonal(hessian))
    unit = 1.0 / np.where(root > 0.0, root, 1.0)
    return unit, hessian * (unit[:, None] * unit)


def _solve_step(hessian: Array, b: Array) -> Array:
    """H^-1 b; where two sizes do the same and hardly have a prior, they share it."""
    unit, scaled = _to_unit_diagonal(hessian)
    # LAPACK's own: what SciPy checks around it takes ten times as long as a few unknowns
    _, found, failed = linalg.lapack.dposv(scaled, unit * b)
    if failed:
        found = linalg.lstsq(scaled, unit * b)[0]
    return np.asarray(unit * found)
