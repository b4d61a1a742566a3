"""Forms that a law may have: formulas of one variable, fitted to the law before it had a form.

The factors of a basis with their covariance stand for the record, so that a form costs no
simulation here. The best ones are then fitted in the simulator, like any cause.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

Array = NDArray[np.float64]
NUM_STARTS = 7  # of each number of a form, over the range of its variable
WIDE = 10.0  # of the prior of a form's number, in sd that the record leaves


@dataclass(frozen=True)
class Form:
    """A formula with a size and further numbers.

    Attributes:
        name: Kind of the formula.
        term: Formula of ``u``, ``size`` and the numbers; {low}, {high}, {mid} are of the range.
        numbers: Names of the numbers.
        shape: Function (scaled variable in -1 to 1, numbers) -> the formula at size 1.
        starts: Starts of each number, in the scaled variable.
        bounds: Bounds of each number, in the scaled variable.
        scales: How each number becomes one of the variable: "place", "length", "rate" or "-".
    """

    name: str
    term: str
    shape: Callable[[Array, Sequence[float]], Array]
    numbers: tuple[str, ...] = ()
    starts: tuple[tuple[float, ...], ...] = ()
    bounds: tuple[tuple[float, float], ...] = ()
    scales: tuple[str, ...] = ()


def _places(low: float, high: float) -> tuple[float, ...]:
    return tuple(np.linspace(low, high, NUM_STARTS).tolist())


#: z is the variable from -1 to 1 over its range
FORMS: tuple[Form, ...] = (
    Form("line", "size*(u - {mid})", lambda z, p: z),
    Form("square", "size*(u - {mid})**2", lambda z, p: z**2),
    Form(
        "exponential",
        "size*(exp(rate*(u - {mid})) - 1)",
        lambda z, p: np.exp(p[0] * z) - 1.0,
        ("rate",),
        ((-8.0, -3.0, -1.0, -0.4, 0.4, 1.0, 3.0, 8.0),),
        ((-40.0, 40.0),),
        ("rate",),
    ),
    Form(
        "threshold",
        "size*max(u - threshold, 0)",
        lambda z, p: np.maximum(z - p[0], 0.0),
        ("threshold",),
        (_places(-0.8, 0.8),),
        ((-0.98, 0.98),),
        ("place",),
    ),
    Form(
        "threshold",
        "size*max(threshold - u, 0)",
        lambda z, p: np.maximum(p[0] - z, 0.0),
        ("threshold",),
        (_places(-0.8, 0.8),),
        ((-0.98, 0.98),),
        ("place",),
    ),
    Form(
        "saturation",
        "size*tanh((u - middle)/width)",
        lambda z, p: np.tanh((z - p[0]) / p[1]),
        ("middle", "width"),
        ((-0.5, 0.0, 0.5), (0.03, 0.2, 0.7)),
        ((-1.0, 1.0), (0.005, 3.0)),
        ("place", "length"),
    ),
    Form(
        "reciprocal",
        "size/(u - {low} + distance)",
        lambda z, p: 1.0 / (z + 1.0 + p[0]),
        ("distance",),
        ((0.02, 0.1, 0.5, 2.0),),
        ((0.003, 20.0),),
        ("length",),
    ),
    Form(
        "reciprocal",
        "size/(u - {low} + distance)**2",
        lambda z, p: 1.0 / (z + 1.0 + p[0]) ** 2,
        ("distance",),
        ((0.02, 0.1, 0.5, 2.0),),
        ((0.003, 20.0),),
        ("length",),
    ),
    Form(
        "reciprocal",
        "size/({high} - u + distance)**2",
        lambda z, p: 1.0 / (1.0 - z + p[0]) ** 2,
        ("distance",),
        ((0.02, 0.1, 0.5, 2.0),),
        ((0.003, 20.0),),
        ("length",),
    ),
    Form(
        "power",
        "size*max(u - {low}, 0)**exponent",
        lambda z, p: np.maximum(z + 1.0, 1e-9) ** p[0],
        ("exponent",),
        ((0.3, 0.5, 1.5, 2.0, 3.0, 5.0),),
        ((0.1, 8.0),),
        ("-",),
    ),
)
#: the same, of variables that reach zero, as heat does: even and odd powers
FORMS_THROUGH_ZERO: tuple[Form, ...] = (
    Form("line", "size*u", lambda u, p: u),
    Form("square", "size*u**2", lambda u, p: u**2),
    Form("square", "size*u*abs(u)", lambda u, p: u * np.abs(u)),
    Form("power", "size*u**3", lambda u, p: u**3),
    Form("line", "size*abs(u)", lambda u, p: np.abs(u)),
)


@dataclass(frozen=True, eq=False)
class FittedForm:
    """A form at its best beside the law without one.

    Attributes:
        form: The form.
        nats: Half its misfit to the law, and half a nat for each number.
        size: Its size.
        numbers: Its numbers in units of the variable, with their sd.
        term: Formula with the range put in.
    """

    form: Form
    nats: float
    size: float
    numbers: dict[str, tuple[float, float]] = field(default_factory=dict)
    term: str = ""


@dataclass(frozen=True, eq=False)
class Curve:
    """A law without a form, as the record tells it.

    Attributes:
        u: Values of the variable over which it is told, ascending, (m,).
        values: The law there, (m,) [unit of the entry].
        basis: Terms of the basis there, (m, k).
        factors: Most probable factors, (k,).
        covariance: Their covariance, (k, k).
    """

    u: Array
    values: Array
    basis: Array
    factors: Array
    covariance: Array

    @property
    def sd(self) -> Array:
        """Standard deviation of the law at ``u``, (m,)."""
        return np.sqrt(np.einsum("ij,jk,ik->i", self.basis, self.covariance, self.basis))


def fit_forms(curve: Curve) -> list[FittedForm]:
    """All forms beside a curve, the best first."""
    low, high = float(curve.u[0]), float(curve.u[-1])
    mid, half = 0.5 * (low + high), 0.5 * (high - low)
    z = (curve.u - mid) / half
    project = linalg.pinv(curve.basis)
    root = linalg.cholesky(_precision(curve.covariance))
    out = [_fit(form, z, curve, project, root, mid, half) for form in FORMS]
    if low < 0.1 * half and high > -0.1 * half:
        out += [_fit(form, curve.u, curve, project, root, mid, half) for form in FORMS_THROUGH_ZERO]
    return sorted((f for f in out if np.isfinite(f.nats)), key=lambda f: f.nats)


def _precision(covariance: Array) -> Array:
    """Inverse of a covariance, directions that the record does not tell without weight."""
    return np.asarray(
        linalg.inv(covariance + 1e-9 * np.trace(covariance) * np.eye(len(covariance)))
    )


def _fit(
    form: Form, z: Array, curve: Curve, project: Array, root: Array, mid: float, half: float
) -> FittedForm:
    def off(numbers: Sequence[float]) -> Array:
        shape = root @ (project @ form.shape(z, numbers))
        target = root @ curve.factors
        power = float(shape @ shape)
        size = float(shape @ target) / power if power > 0.0 else 0.0
        return np.asarray(target - size * shape)

    best: list[float] = []
    cost = 0.5 * float(off(()) @ off(())) if not form.numbers else np.inf
    low = [b[0] for b in form.bounds]
    high = [b[1] for b in form.bounds]
    for start in _starts(form):
        with np.errstate(all="ignore"):
            try:
                ended = optimize.least_squares(off, start, bounds=(low, high), max_nfev=60)
            except ValueError:  # no finite numbers from here
                continue
        if ended.cost < cost:
            best, cost, slopes = ended.x.tolist(), float(ended.cost), ended.jac
    if not np.isfinite(cost):
        return FittedForm(form, np.inf, 0.0)
    shape = np.asarray(project @ form.shape(z, best))
    weighed = root @ shape
    size = float(weighed @ (root @ curve.factors)) / max(float(weighed @ weighed), 1e-300)
    numbers = {}
    if form.numbers:
        spread = np.sqrt(np.diag(linalg.pinv(slopes.T @ slopes)))
        for name, kind, value, sd in zip(form.numbers, form.scales, best, spread, strict=True):
            numbers[name] = _in_units(kind, value, float(sd), mid, half)
    size *= _size_factor(form, half, best)
    u_low, u_high = float(curve.u[0]), float(curve.u[-1])
    term = form.term.format(low=repr(u_low), high=repr(u_high), mid=repr(mid))
    return FittedForm(form, cost + 0.5 * len(form.numbers), size, numbers, term)


def _starts(form: Form) -> list[tuple[float, ...]]:
    starts: list[tuple[float, ...]] = [()]
    for values in form.starts:
        starts = [(*s, v) for s in starts for v in values]
    return starts if form.numbers else []


def _in_units(kind: str, value: float, sd: float, mid: float, half: float) -> tuple[float, float]:
    if kind == "place":
        return mid + half * value, half * sd
    if kind == "length":
        return half * value, half * sd
    if kind == "rate":
        return value / half, sd / half
    return value, sd


def _size_factor(form: Form, half: float, numbers: Sequence[float]) -> float:
    """What the size is multiplied by, where the variable is scaled."""
    if form in FORMS_THROUGH_ZERO:
        return 1.0
    if form.name in ("line", "threshold"):
        return 1.0 / half
    if form.name == "power":
        return half ** -float(numbers[0])
    if form.name == "square":
        return 1.0 / half**2
    if form.name == "reciprocal":
        return half**2 if "**2" in form.term else half
    return 1.0
