"""Forms that a law may have: formulas of one variable, fitted to what the record tells of the law.

What the record tells is a parabola in the values of the law on a fine grid, by the slopes of the
simulation that lies on it, so that a form costs no simulation here. The best ones are then fitted
in the simulator, like any cause.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import linalg, optimize

from diffsim.core.arrays import Array

FORM_PRIOR_SD = 10.0  # of the prior of a form's number, in sd that the record leaves
NUMBER_NATS = float(np.log(FORM_PRIOR_SD))  # what each number costs, by that prior
SAME_NATS = 2.0  # between forms that no record of this kind tells apart
# of what a form does to the record, squared: closer than 1 % slopes tell none. Leaks of 170,000
# nats and a resistance had exponentials beside their lines that were 0.5 and 0.8 % off these
SAME_SHARE = 1e-4
NUM_TRIED = 2  # starts that are followed to their end
# by how much a number may be bent by what is missing, sd as a share: a shaker's force constant was
# 1.4 times what its fit with bumps held, as these had a level
BENT = 0.3
NEAR_END = 0.5  # of the half range: a range that begins there is one from zero, as 12 to 95 %
NEAR_ZERO = 1e-3  # of the half range, within which a power with a steep begin is a line
LINE = "u - {mid}"
LEVEL, ZERO = "level", "zero"  # numbers of forms that are zero elsewhere


@dataclass(frozen=True)
class Form:
    """A formula with a size and further numbers.

    Attributes:
        name: Kind of the formula.
        core: Formula of ``u`` and the numbers at size 1; {low}, {high}, {mid} are of the range,
            {near} is the square of what is near zero in it.
        shape: Function (scaled variable in -1 to 1, numbers) -> the formula at size 1.
        numbers: Names of the numbers.
        starts: Starts of each number, in the scaled variable.
        bounds: Bounds of each number, in the scaled variable.
        scales: How each number becomes one of the variable: "place", "length", "rate" or "-".
        power: What the size is multiplied by, as a power of the variable's unit.
        zero: What is taken from the core, so that a number's factor is 1 in the middle.
        is_factor: Whether it is a change of a number as a share, of which the size is the only
            number.
        signed: Whether the size may be negative.
    """

    name: str
    core: str
    shape: Callable[[Array, Sequence[float]], Array]
    numbers: tuple[str, ...] = ()
    starts: tuple[tuple[float, ...], ...] = ()
    bounds: tuple[tuple[float, float], ...] = ()
    scales: tuple[str, ...] = ()
    power: float = 0.0
    zero: float = 0.0
    is_factor: bool = False
    signed: bool = True


def _places(low: float, high: float) -> tuple[float, ...]:
    """Starts of a number of a form, over the range of its variable."""
    return tuple(np.linspace(low, high, 7).tolist())


def _reciprocal(beyond: str, away: Callable[[Array], Array], power: int) -> Form:
    """One over a power of the distance from a place beyond an end of the range."""
    return Form(
        "reciprocal",
        f"1/({beyond} + distance)" + (f"**{power}" if power > 1 else ""),
        lambda z, p: 1.0 / (away(z) + p[0]) ** power,
        ("distance",),
        ((0.02, 0.1, 0.5, 2.0),),
        ((0.003, 20.0),),
        ("length",),
        -float(power),
    )


def _threshold(
    core: str,
    beyond: Callable[[Array, float], Array],
    starts: tuple[float, float] = (-0.8, 0.8),
    least: float = -0.98,
    scale: str = "place",
) -> Form:
    """What acts beyond a place.

    Args:
        starts: First and last of the places at which it is looked for.
        least: Lowest place.
        scale: Of the place, as ``Form.scales``.
    """
    return Form(
        "threshold",
        core,
        lambda z, p: beyond(z, p[0]),
        ("threshold",),
        (_places(*starts),),
        ((least, 0.98),),
        (scale,),
        1.0,
    )


def _both_sides(core: str, beyond: Callable[[Array, float], Array]) -> Form:
    return _threshold(core, beyond, (0.05, 0.95), 0.01, "length")


def _step(core: str, shape: Callable[[Array, Sequence[float]], Array]) -> Form:
    return Form(
        "step",
        core,
        shape,
        ("middle", "width"),
        (_places(0.05, 0.95), (0.01, 0.05)),
        ((0.05, 0.98), (0.002, 0.1)),  # wider, and about zero, it would be any smooth curve
        ("length", "length"),
    )


#: z is the variable from -1 to 1 over its range; of forms that the record cannot tell apart and
#: that have as many numbers, the first one is taken
FORMS: tuple[Form, ...] = (
    Form("line", LINE, lambda z, p: z, power=1.0),
    Form("square", "(u - {mid})**2", lambda z, p: z**2, power=2.0),
    Form(
        "exponential",
        "exp(rate*(u - {mid}))",
        lambda z, p: np.exp(p[0] * z),
        ("rate",),
        ((-8.0, -3.0, -1.0, -0.4, 0.4, 1.0, 3.0, 8.0),),
        ((-40.0, 40.0),),
        ("rate",),
        zero=1.0,
    ),
    _threshold("max(u - threshold, 0)", lambda z, at: np.maximum(z - at, 0.0)),
    _threshold("max(threshold - u, 0)", lambda z, at: np.maximum(at - z, 0.0)),
    Form(
        "saturation",
        "tanh((u - middle)/width)",
        lambda z, p: np.tanh((z - p[0]) / p[1]),
        ("middle", "width"),
        ((-0.5, 0.0, 0.5), (0.03, 0.2, 0.7)),
        ((-1.0, 1.0), (0.005, 3.0)),
        ("place", "length"),
    ),
    *(_reciprocal("u - {low}", lambda z: z + 1.0, power) for power in (1, 2)),
    *(_reciprocal("{high} - u", lambda z: 1.0 - z, power) for power in (1, 2)),
    Form(
        "power",
        "max(u - {low}, 0)**exponent",
        lambda z, p: np.maximum(z + 1.0, 1e-9) ** p[0],
        ("exponent",),
        ((0.3, 0.5, 1.5, 2.0, 3.0, 5.0),),
        ((0.1, 8.0),),
        ("-",),
    ),
)
#: the same, of variables that reach zero, as heat does: even and odd powers
FORMS_THROUGH_ZERO: tuple[Form, ...] = (
    Form("line", "u", lambda u, p: u, power=1.0),
    Form("square", "u**2", lambda u, p: u**2, power=2.0),
    Form("square", "u*abs(u)", lambda u, p: u * np.abs(u), power=2.0),
    Form("power", "u**3", lambda u, p: u**3, power=3.0),
    Form("line", "abs(u)", lambda u, p: np.abs(u), power=1.0),
    # sign(u)*abs(u)**exponent, such as of an orifice, with a finite slope at zero
    Form(
        "power",
        "u*(u**2 + {near})**((exponent - 1)/2)",
        lambda u, p: u * (u**2 + NEAR_ZERO**2) ** (0.5 * (p[0] - 1.0)),
        ("exponent",),
        ((0.3, 0.6, 1.4, 2.5),),
        ((0.1, 8.0),),
        ("-",),
    ),
    # what pulls most at one speed: an eddy-current brake, a tire that slides, a pump that cavitates
    Form(
        "peak",
        "u/(1 + (u/peak)**2)",
        lambda u, p: u / (1.0 + (u / p[0]) ** 2),
        ("peak",),
        ((0.1, 0.3, 0.8),),
        ((0.02, 2.0),),
        ("length",),
        1.0,
    ),
)
#: the same, of variables that go to both sides of zero: what acts beyond a place, such as a stop,
#: and what comes all at once there, such as a centrifugal brake; odd and even
FORMS_TO_BOTH_SIDES: tuple[Form, ...] = (
    _both_sides("u - min(max(u, -threshold), threshold)", lambda u, at: u - np.clip(u, -at, at)),
    _both_sides("max(abs(u) - threshold, 0)", lambda u, at: np.maximum(np.abs(u) - at, 0.0)),
    _step(
        "0.5*(tanh((u - middle)/width) + tanh((u + middle)/width))",
        lambda u, p: 0.5 * (np.tanh((u - p[0]) / p[1]) + np.tanh((u + p[0]) / p[1])),
    ),
    _step(
        "0.5*tanh((abs(u) - middle)/width) + 0.5",
        lambda u, p: 0.5 * np.tanh((np.abs(u) - p[0]) / p[1]) + 0.5,
    ),
)
#: the same, of variables that stay above zero, in shares of the middle, which is {high}
FORMS_ABOVE_ZERO: tuple[Form, ...] = (
    Form(
        "power",
        "u**exponent",
        lambda z, p: z ** p[0],
        ("exponent",),
        ((-2.0, -1.0, -0.5, 0.5, 2.0, 4.0),),
        ((-8.0, 8.0),),
        ("-",),
    ),
)
#: what a number may be multiplied by, with the size as its only number
FACTORS: tuple[Form, ...] = (
    Form(
        "exponential",
        "exp(size*(u - {mid})) - 1",
        lambda z, p: np.expm1(p[0] * z),
        ("size",),
        ((-3.0, -0.3, 0.3, 3.0),),
        ((-40.0, 40.0),),
        power=1.0,
        is_factor=True,
    ),
)
#: the same, of variables that stay above zero
FACTORS_ABOVE_ZERO: tuple[Form, ...] = (
    Form(
        "power",
        "(u/{high})**size - 1",
        lambda z, p: z ** p[0] - 1.0,
        ("size",),
        ((-2.0, -1.0, -0.5, 0.5, 1.0, 2.0),),
        ((-8.0, 8.0),),
        is_factor=True,
    ),
)
#: the same, of variables that go through zero: it falls to both sides, never below zero
FACTORS_THROUGH_ZERO: tuple[Form, ...] = tuple(
    Form(
        "saturation",
        core,
        shape,
        ("size",),
        ((0.1, 1.0, 10.0),),
        ((1e-4, 1e4),),
        power=2.0,
        is_factor=True,
        signed=False,
    )
    for core, shape in (
        ("1/sqrt(1 + size*u**2) - 1", lambda u, p: 1.0 / np.sqrt(1.0 + p[0] * u**2) - 1.0),
        ("1/(1 + size*u**2) - 1", lambda u, p: 1.0 / (1.0 + p[0] * u**2) - 1.0),
    )
)


@dataclass(frozen=True, eq=False)
class FittedForm:
    """A form at its best beside what the record tells."""

    form: Form
    nats: float  # what it leaves [nats], and the price of its numbers
    size: float
    # its numbers in units of the variable, with their sd
    numbers: dict[str, tuple[float, float]] = field(default_factory=dict)
    term: str = ""  # formula with the range put in
    # what it does to the record, in noise sd
    seen: Array = field(default_factory=lambda: np.zeros(0))

    def stands_for(self, other: FittedForm) -> bool:
        """Whether the record tells no difference to another one, which is no better; of a line,
        whether slopes tell none to one with further numbers."""
        share = SAME_SHARE if other.numbers and self.form.name == "line" else 0.0
        same = max(SAME_NATS, 0.5 * share * float(np.sum(other.seen**2)))
        apart = 0.5 * float(np.sum((self.seen - other.seen) ** 2))
        return apart < same and self.nats < other.nats + same


@dataclass(frozen=True, eq=False)
class Curve:
    """A law without a form, as the record tells it."""

    u: Array  # values of the variable over which it is told, ascending, (m,)
    values: Array  # the law there, (m,) [unit of the entry]
    basis: Array  # terms of the basis there, (m, k)
    factors: Array  # most probable factors, (k,)
    covariance: Array  # their covariance, (k, k)

    @property
    def sd(self) -> Array:
        """Standard deviation of the law at ``u``, (m,)."""
        return np.sqrt(np.einsum("ij,jk,ik->i", self.basis, self.covariance, self.basis))


@dataclass(frozen=True, eq=False)
class LawMisfit:
    """What a record tells of a law over its variable, without any prior of the law.

    The misfit of a law with values v at ``u`` is |target - root v|^2 and a constant.
    """

    u: Array  # values of the variable, ascending, (m,)
    root: Array  # what a law's values do to the record, in noise sd, (k, m)
    target: Array  # what the record asks for, (k,)
    # whether the law changes a free number, whose own value holds what is level
    of_number: bool = False

    def without_level(self) -> LawMisfit:
        """The same, what is level taken out: it says nothing of a law."""
        level = self.root.sum(1)
        along = level / max(float(linalg.norm(level)), 1e-300)
        root = self.root - np.outer(along, along @ self.root)
        return replace(self, root=root, target=self.target - along * (along @ self.target))

    def left_by(self, basis: Array) -> float:
        """Nats that the best sum of terms leaves, (m, k) at ``u``."""
        shapes = self.root @ basis
        factors, *_ = linalg.lstsq(shapes, self.target)
        return 0.5 * float(np.sum((self.target - shapes @ factors) ** 2))


def fit_forms(told: LawMisfit) -> list[FittedForm]:
    """Forms beside what a record tells, the best first; of those that it cannot tell apart the one
    with the fewest numbers."""
    low, high = float(told.u[0]), float(told.u[-1])
    mid, half = 0.5 * (low + high), 0.5 * (high - low)
    reaches_zero = low < NEAR_END * half and high > -NEAR_END * half
    if told.of_number:
        told = told.without_level()
    over_range = _ScaledLaw(told, low, high, mid, half)
    fitted = []
    if reaches_zero:
        at_zero = replace(over_range, mid=0.0)
        forms = (*FACTORS_THROUGH_ZERO, *FORMS_THROUGH_ZERO)
        if low < -0.1 * half and high > 0.1 * half:
            forms += FORMS_TO_BOTH_SIDES
        fitted += [at_zero.fit(form) for form in forms if told.of_number or not form.is_factor]
    levels = (False,) if told.of_number else (False, True)
    fitted += [over_range.fit(form, has_level) for form in FORMS for has_level in levels]
    if told.of_number:
        fitted += [over_range.fit(form) for form in FACTORS]
    if low > 0.0:
        of_middle = _ScaledLaw(told, -mid, mid, 0.0, mid)
        above = (*(FACTORS_ABOVE_ZERO if told.of_number else ()), *FORMS_ABOVE_ZERO)
        fitted += [of_middle.fit(form, has_level) for form in above for has_level in levels]
    kept: list[FittedForm] = []
    for found in sorted((f for f in fitted if f is not None), key=lambda f: len(f.numbers)):
        if not any(f.stands_for(found) for f in kept):
            kept.append(found)
    return sorted(kept, key=lambda f: f.nats)


@dataclass(frozen=True, eq=False)
class _ScaledLaw:
    """What a record tells, over a variable from -1 to 1."""

    told: LawMisfit
    low: float
    high: float
    mid: float
    half: float  # of the range, which the variable is scaled by

    def fit(self, form: Form, has_level: bool = False) -> FittedForm | None:
        """A form at its best, less a level of its own or not; None where it cannot be fitted."""
        root, target = self.told.root, self.told.target
        z = (self.told.u - self.mid) / self.half
        zero = form.zero if self.told.of_number else 0.0

        def terms(numbers: Sequence[float]) -> Array:
            """What the form does to the record at size 1, and its level."""
            columns = [form.shape(z, numbers) - zero, *([np.ones(len(z))] if has_level else [])]
            return np.asarray(root @ np.stack(columns, 1))

        def sizes(shapes: Array) -> Array:
            if form.is_factor:  # of a number that what is missing has bent by some share
                told = shapes[:, 0] @ shapes[:, 0] + BENT**-2
                return np.asarray([(shapes[:, 0] @ target + BENT**-2) / told])
            return np.asarray(linalg.lstsq(shapes, target, check_finite=False)[0])

        def off(numbers: Sequence[float]) -> Array:
            shapes = terms(numbers)
            found = sizes(shapes)
            bent = (found - 1.0) / BENT if form.is_factor else np.zeros(0)
            return np.concatenate([target - shapes @ found, bent])

        best = self._search(form, off)
        if best is None:
            return None
        shapes = terms(best)
        found = sizes(shapes)
        left = off(best)
        spread = self._spread(form, best, found, terms)
        count = len(form.numbers) - form.is_factor + has_level
        nats = 0.5 * float(left @ left) + NUMBER_NATS * count
        return self._in_units(form, nats, best, found, spread, shapes @ found)

    def _search(
        self, form: Form, off: Callable[[Sequence[float]], Array]
    ) -> tuple[float, ...] | None:
        """The best numbers, from the best of all starts; None where no start is finite."""
        if not form.numbers:
            return ()
        starts: list[tuple[float, ...]] = [()]
        for values in form.starts:
            starts = [(*s, v) for s in starts for v in values]
        low, high = (np.array(ends) for ends in zip(*form.bounds, strict=True))
        with np.errstate(all="ignore"):
            costs = [float(np.sum(off(s) ** 2)) for s in starts]
            order = [int(i) for i in np.argsort(costs) if np.isfinite(costs[i])][:NUM_TRIED]
            ended = []
            for i in order:
                try:
                    ended.append(
                        optimize.least_squares(off, starts[i], bounds=(low, high), max_nfev=60)
                    )
                except ValueError:  # no finite numbers from here
                    continue
        if not ended:
            return None
        return tuple(min(ended, key=lambda e: float(e.cost)).x.tolist())

    def _spread(
        self,
        form: Form,
        numbers: tuple[float, ...],
        sizes: Array,
        terms: Callable[[Sequence[float]], Array],
    ) -> Array:
        """Covariance of numbers and sizes, (n, n)."""
        shapes, columns = terms(numbers), []
        for k, value in enumerate(numbers):
            step = 1e-4 * max(abs(value), 1e-2)
            moved = list(numbers)
            moved[k] = value + step
            columns.append((terms(moved) - shapes) @ sizes / step)
        slopes = np.column_stack([*columns, shapes])
        return np.asarray(linalg.pinvh(slopes.T @ slopes))

    def _in_units(
        self,
        form: Form,
        nats: float,
        numbers: tuple[float, ...],
        sizes: Array,
        spread: Array,
        seen: Array,
    ) -> FittedForm:
        power = float(numbers[0]) if form.scales == ("-",) else form.power
        unit = self.half**power
        size = float(sizes[0]) / unit
        sd = np.sqrt(np.maximum(np.diag(spread), 0.0))
        per = {"place": self.half, "length": self.half, "rate": 1.0 / self.half}
        told = {}
        for k, (name, kind) in enumerate(zip(form.numbers, form.scales, strict=False)):
            value, scale = numbers[k], per.get(kind, 1.0)
            at = self.mid if kind == "place" else 0.0
            told[name] = (at + scale * value, scale * float(sd[k]))
        core, natural = form.core, form.zero if self.told.of_number else 0.0
        if form.is_factor:
            size = float(numbers[0]) / unit
        elif len(sizes) > 1:
            level = -float(sizes[1] / sizes[0])
            slope = np.array([level, 1.0]) / sizes[0]
            off = float(np.sqrt(max(slope @ spread[-2:, -2:] @ slope, 0.0)))
            if core == LINE:
                core = f"u - {ZERO}"
                told[ZERO] = (self.mid + unit * level, unit * off)
            else:
                core = f"{core} - {LEVEL}"
                told[LEVEL] = (unit * level, unit * off)
        elif natural:
            core = f"{core} - {natural:g}"
        term = core if form.is_factor else f"size*({core})"
        ends = {"low": self.low, "high": self.high, "mid": self.mid}
        term = term.format(
            near=repr((NEAR_ZERO * self.half) ** 2), **{k: repr(v) for k, v in ends.items()}
        )
        return FittedForm(form, nats, size, told, term, seen)
