"""Responses of linear pieces: a chamber behind a valve, one mode under a moment."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
VALVE = 0.01  # [s] to switch, one sample


def linear_mode(w: Array, damping_ratio: Array, held: Array, steps: Array) -> Array:
    """(T, K) of q'' + 2 zeta w q' + w^2 q = w^2 held from rest, trapezoidal rule."""
    rate, w2 = 2.0 * damping_ratio * w, w * w
    q = qd = np.zeros(held.shape[1])
    out = [q]
    for h, force in zip(steps.tolist(), 0.5 * w2 * (held[:-1] + held[1:]), strict=True):
        below = 1.0 + 0.5 * h * rate + 0.25 * h * h * w2
        new = (qd * (2.0 - below) + h * (force - w2 * q)) / below
        q, qd = q + 0.5 * h * (qd + new), new
        out.append(q)
    return np.stack(out)


def filled(since: Array, lag: Array) -> Array:
    """(T, K) share of a step that has passed a lag, the valve taking ``VALVE`` to switch.

    The ramp makes the share smooth in the moment of the switch, also without a lag.
    """
    late, early = (np.maximum(since + s * 0.5 * VALVE, 0.0) for s in (1.0, -1.0))
    safe = np.maximum(lag, 1e-3 * VALVE)

    def integral(t: Array) -> Array:
        return np.asarray(t - safe * (1.0 - np.exp(-t / safe)))

    return np.asarray((integral(late) - integral(early)) / VALVE)
