"""Cyclic commands of a servo: one period of tendon contraction, and what the servo can follow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim.core.check import require_number

Array = NDArray[np.float64]
RATE_HZ = 60.0  # of commands and recordings, thesis 5.4.1


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What may be commanded.

    Attributes:
        contraction_m: Longest pull of the tendons [m]; the shortest is 0.
        rate_m_s: Fastest change [m/s].
    """

    contraction_m: float = 0.015
    rate_m_s: float = 0.15

    def __post_init__(self) -> None:
        require_number("contraction_m", self.contraction_m, above=0.0, below=0.065)
        require_number("rate_m_s", self.rate_m_s, above=0.0)


@dataclass(frozen=True, eq=False)
class Command:
    """One period of contraction at ``RATE_HZ``, repeated as long as asked for.

    Attributes:
        contraction_m: (num_samples,) [m].
    """

    contraction_m: Array

    def __post_init__(self) -> None:
        values = self.contraction_m
        if values.ndim != 1 or len(values) < 2 or not np.isfinite(values).all():
            raise ValueError(
                "contraction_m must be (num_samples,), at least two finite numbers in meters, got "
                f"shape {values.shape}"
            )

    @property
    def period_s(self) -> float:
        """[s]."""
        return len(self.contraction_m) / RATE_HZ

    def during(self, duration_s: float) -> Array:
        """(round(duration_s RATE_HZ),) contraction [m], from the start of a period."""
        return np.resize(self.contraction_m, round(duration_s * RATE_HZ))

    def check(self, limits: Limits, *, atol_m: float = 1e-9) -> None:
        """Refuse what the servo cannot follow.

        Raises:
            ValueError: out of bounds or too fast, the jump back to the period's start included.
        """
        c = self.contraction_m
        if c.min() < -atol_m or c.max() > limits.contraction_m + atol_m:
            raise ValueError(
                f"contraction must lie in [0, {limits.contraction_m:g}] m, got "
                f"[{c.min():g}, {c.max():g}] m; scale the command"
            )
        fastest = float(np.abs(np.diff(c, append=c[0])).max()) * RATE_HZ
        if fastest > limits.rate_m_s + 2.0 * RATE_HZ * atol_m:
            raise ValueError(
                f"contraction must change by at most {limits.rate_m_s:g} m/s, got {fastest:g} m/s; "
                "pass it through labs.loop.followed"
            )


def sinusoid(
    *, period_s: float = 3.0, cycles: int = 3, amplitude_m: float = 0.006, limits: Limits
) -> Command:
    """The hand-made baseline bl-ctrl (thesis 5.4.3): 0 to twice the amplitude, ``cycles`` times.

    Raises:
        ValueError: beyond the limits.
    """
    n = round(period_s * RATE_HZ)
    phase = 2.0 * np.pi * cycles * np.arange(n) / n
    command = Command(amplitude_m * (1.0 - np.cos(phase)))
    command.check(limits)
    return command


def open_close(
    *,
    period_s: float = 0.55,
    low_m: float = 0.0,
    high_m: float = 0.018,
    closed: float = 0.5,
    limits: Limits,
) -> Command:
    """Strokes of the real robot (``horizontal_cyclic1``): closed, then open, as fast as allowed.

    Args:
        period_s: Duration of one stroke [s].
        low_m, high_m: Contraction while open and while closed [m].
        closed: Share of the period that asks for ``high_m``.
        limits: Limits of the servo, which the command respects.
    """
    closed = require_number("closed", closed, above=0.0, below=1.0)
    n = round(period_s * RATE_HZ)
    wish = np.where(np.arange(n) < round(closed * n), high_m, low_m)
    return Command(followed(torch.from_numpy(wish), limits).numpy())


def followed(contraction: Tensor, limits: Limits) -> Tensor:
    """A period within bounds and rate: the nearest that a servo can follow causally.

    Args:
        contraction: (num_samples,) wish for one period [m].
        limits: Limits of the servo.

    Returns:
        (num_samples,) [m], the jump back to the start included. Gradient: contraction.
    """
    step = limits.rate_m_s / RATE_HZ
    wish = contraction.clamp(0.0, limits.contraction_m)
    begin = wish[-1]
    for _ in range(2):  # where a servo that has run for periods begins
        begin = _chase(wish, begin, step)[-1]
    return _chase(wish, begin, step)


def _chase(wish: Tensor, begin: Tensor, step: float) -> Tensor:
    now, out = begin, []
    for target in wish:
        now = now + (target - now).clamp(-step, step)
        out.append(now)
    return torch.stack(out)


def interpolation(num_knots: int, num_samples: int) -> Array:
    """(num_samples, num_knots): straight lines between knots evenly spaced over a period."""
    place, knots = np.arange(num_samples) * num_knots / num_samples, np.arange(num_knots)
    hats = [np.interp(place, knots, hat, period=num_knots) for hat in np.eye(num_knots)]
    return np.stack(hats, axis=1)
