"""Intervals of what is computed from the numbers of a saved model.

Each number is drawn from its 90 % interval (``Range.drawn``); draws of several numbers have the
correlations of the posterior. So a formula of one number gets that number's own interval,
and one of several numbers what they allow together: a ratio may be known where its parts are not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from scipy.special import ndtri
from torch import Tensor

from diffsim.identify.fitting import Fit, correlated

NUM_DRAWS = 2**14  # evenly spread: ends are exact to about a hundredth of a standard deviation
LEVEL = 0.9  # of every interval
HALF_LEVEL = float(ndtri(0.5 * (1.0 + LEVEL)))  # half of a normal interval [sd]
SURE_SD = 3.0  # standard deviations beyond which nothing is by chance
Formula = Callable[[Mapping[str, Tensor]], Tensor]


class Range(NamedTuple):
    """A value with its 90 % interval, in one unit, which need not be symmetric."""

    value: float
    low: float
    high: float

    def drawn(self, normal: Tensor) -> Tensor:
        """The number at draws of a standard normal, of any shape.

        Two halves of a normal, each as wide as the interval on its side; in logarithms where the
        whole interval has one sign. An interval that begins at 0 is of a number without a sign.
        """
        if self.low > 0.0 or self.high < 0.0:
            sign = 1.0 if self.low > 0.0 else -1.0
            low, value, high = sorted(math.log(abs(end)) for end in self)
            return sign * torch.exp(_two_halves(low, value, high, sign * normal))
        number = _two_halves(self.low, self.value, self.high, normal)
        return number.clamp(min=0.0) if self.low == 0.0 else number


def _two_halves(low: float, value: float, high: float, normal: Tensor) -> Tensor:
    above, below = (high - value) / HALF_LEVEL, (value - low) / HALF_LEVEL
    return value + normal * torch.where(normal > 0.0, above, below)


class Numbers(Protocol):
    """Numbers with intervals and correlations; a ``SavedModel`` is one."""

    @property
    def values(self) -> Mapping[str, float]: ...

    @property
    def sd(self) -> Mapping[str, float]: ...

    @property
    def ranges(self) -> Mapping[str, Range]: ...

    def correlation_of(self, a: str, b: str) -> float:
        """Of two numbers in the posterior."""


@dataclass(frozen=True, eq=False)
class FittedNumbers:
    """Numbers of a fit with the intervals of an answer."""

    fit: Fit
    ranges: Mapping[str, Range]  # 90 % intervals by name

    @property
    def values(self) -> Mapping[str, float]:
        """Fitted values by name, each in its unit."""
        return self.fit.values

    @property
    def sd(self) -> Mapping[str, float]:
        """Standard deviations of the fit alone."""
        return self.fit.sd

    def correlation_of(self, a: str, b: str) -> float:
        """Of two numbers in the posterior."""
        names = self.fit.problem.names
        return float(self.fit.correlation[names.index(a), names.index(b)])


def range_of_number(saved: Numbers, name: str) -> Range:
    """Value and 90 % interval of a number, in its unit.

    Args:
        name: Parameter or component of the file. Where the file has no interval, it is made of the
            standard deviation of the fit.
    """
    value, half = saved.values[name], HALF_LEVEL * saved.sd[name]
    return saved.ranges.get(name, Range(value, value - half, value + half))


def range_of(formula: Formula, names: Sequence[str], saved: Numbers) -> Range:
    """Value and 90 % interval of a formula of saved numbers.

    Args:
        formula: Takes numbers by name, () or (num_draws,) each, and returns as many values.
        names: Numbers of the file that it needs.

    Returns:
        The formula at the saved values, within its interval.
    """
    at = {name: torch.tensor(saved.values[name], dtype=torch.float64) for name in names}
    value = float(formula(at))
    if not names:
        return Range(value, value, value)
    drawn = formula(draws_of(names, saved)).expand(NUM_DRAWS).numpy()
    drawn = drawn[~np.isnan(drawn)]
    if not len(drawn):
        return Range(value, value, value)
    tail = 0.5 * (1.0 - LEVEL)
    low, high = (float(q) for q in np.quantile(drawn, (tail, 1.0 - tail)))
    return Range(value, min(low, value), max(high, value))


def draws_of(names: Sequence[str], saved: Numbers) -> dict[str, Tensor]:
    """Draws of saved numbers, (num_draws,) each in its unit, evenly spread.

    Args:
        names: Parameters and components of the file.
    """
    names = list(dict.fromkeys(names))
    engine = torch.quasirandom.SobolEngine(len(names), scramble=True, seed=0)
    unit = torch.special.ndtri(engine.draw(NUM_DRAWS, dtype=torch.float64).clamp(1e-9, 1.0 - 1e-9))
    mixed = correlated(unit, names, saved.correlation_of)
    normal = mixed / mixed.square().mean(0).sqrt()
    return {n: range_of_number(saved, n).drawn(normal[:, i]) for i, n in enumerate(names)}
