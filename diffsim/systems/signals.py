"""Changes of a sampled signal on its way: differentiable, and the identity at size 0.

Signals are (num_samples, width) at evenly spaced times; those of held commands may have leading
axes.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

_SHORTEST_LAG = 1e-3  # of a step: below it exp(-dt / tau) is zero to the last digit


def sample(values: Tensor, dt: float, times: Tensor, start_rate: Tensor | None = None) -> Tensor:
    """Values at any times of what starts at rest, or at a known rate; held beyond the ends.

    By cubics with slopes of fourth order.

    Args:
        values: (num_steps + 1, width), five steps or more, at 0, dt, 2 dt, ...
        dt: Time between two samples of the signal [s].
        times: Times at which values are wanted, (num_samples,) [s].
        start_rate: (width,) derivative at 0 [1/s]; None: zero.

    Returns:
        (num_samples, width). Gradients: values and, within the record, times.
    """
    last = values.shape[0] - 1
    if last < 5:
        raise ValueError(f"values must hold five steps or more to be interpolated, got {last}")
    slopes = _slopes(values)
    if start_rate is not None:
        slopes = torch.cat([start_rate[None] * dt, slopes[1:]])
    return _cubic(values, slopes, times / dt)


def curved(values: Tensor, dt: float, times: Tensor) -> Tensor:
    """Values (num_samples, width), five or more, at any times by cubics; straight lines beyond.

    Args:
        values: Samples at 0, dt, 2 dt, ...
        dt: Spacing of the samples [s], or of whatever they lie along.
        times: Where values are wanted, (num_times,).
    """
    slopes = torch.cat([_end_slope(values)[None], _slopes(values)[1:]])
    inside = _cubic(values, slopes, times / dt)
    last = values.shape[0] - 1
    place = times / dt
    before, after = place.clamp(max=0.0), (place - last).clamp(min=0.0)
    return inside + before[:, None] * slopes[0] + after[:, None] * slopes[-1]


def _end_slope(y: Tensor) -> Tensor:
    """Change per step at the first sample, of fourth order."""
    return (-25.0 * y[0] + 48.0 * y[1] - 36.0 * y[2] + 16.0 * y[3] - 3.0 * y[4]) / 12.0


def _cubic(values: Tensor, slope: Tensor, place: Tensor) -> Tensor:
    """Cubics through values with slopes per step, at places counted in steps; ends held."""
    last = values.shape[0] - 1
    place = place.clamp(0.0, float(last))
    left = place.detach().floor().long().clamp(max=last - 1)
    s = (place - left)[:, None]
    y0, y1, d0, d1 = values[left], values[left + 1], slope[left], slope[left + 1]
    rise = y1 - y0
    return y0 + s * (d0 + s * (3.0 * rise - 2.0 * d0 - d1 + s * (d0 + d1 - 2.0 * rise)))


def _slopes(y: Tensor) -> Tensor:
    """Change per step at every sample: none at first, else five-point differences."""
    middle = (y[:-4] - 8.0 * y[1:-3] + 8.0 * y[3:-1] - y[4:]) / 12.0
    first = torch.zeros_like(y[0])
    second = (-3.0 * y[0] - 10.0 * y[1] + 18.0 * y[2] - 6.0 * y[3] + y[4]) / 12.0
    z = y.flip(0)
    end = (25.0 * z[0] - 48.0 * z[1] + 36.0 * z[2] - 16.0 * z[3] + 3.0 * z[4]) / 12.0
    before = (3.0 * z[0] + 10.0 * z[1] - 18.0 * z[2] + 6.0 * z[3] - z[4]) / 12.0
    return torch.cat([torch.stack([first, second]), middle, torch.stack([before, end])])


def straight(values: Tensor, dt: float, times: Tensor) -> Tensor:
    """Values (num_samples, width) at any times (num_times,) [s], straight lines, ends held."""
    last = values.shape[0] - 1
    place = (times / dt).clamp(0.0, float(last))
    left = place.detach().floor().long().clamp(max=max(last - 1, 0))
    right = (left + 1).clamp(max=last)
    return values[left] + (place - left)[:, None] * (values[right] - values[left])


def delayed(u: Tensor, dt: float, delay: Tensor) -> Tensor:
    """u(t - delay); before and after the record it stays as it was at the ends.

    In between u is the monotone cubic of Fritsch and Carlson: smooth, so that a delay has a
    derivative, and without overshoot at steps.

    Args:
        u: Signal in columns, (num_samples, width).
        dt: Time between two samples [s].
        delay: Delay, a scalar () [s].
    """
    rise = u.diff(dim=0)
    before, after = rise[:-1], rise[1:]
    alike = before * after > 0.0
    both = torch.where(alike, before + after, 1.0)
    inner = torch.where(alike, 2.0 * before * after / both, 0.0)
    flat = torch.zeros_like(u[:1])
    place = torch.arange(u.shape[0], dtype=u.dtype) - delay / dt
    return _cubic(u, torch.cat([flat, inner, flat]), place)


def lagged(u: Tensor, dt: float, time_constant: Tensor) -> Tensor:
    """First-order lag tau y' = u - y, exact for straight lines between samples, y(0) = u(0).

    The error e = u - y obeys e' = u' - e / tau: after a step with the slope r it is
    r tau + (e - r tau) exp(-dt / tau). At tau = 0 this is u with the derivative -u'.

    Args:
        u: Signal in columns, (num_samples, width).
        dt: Time between two samples [s].
        time_constant: Time constant tau, a scalar () [s], >= 0.
    """
    decay = torch.exp(-dt / time_constant.clamp(min=_SHORTEST_LAG * dt))
    steady = time_constant * u.diff(dim=0) / dt
    error = torch.zeros_like(u[0])
    errors = [error]
    for target in steady:
        error = target + (error - target) * decay
        errors.append(error)
    return u - torch.stack(errors)


def held_lagged(u: Tensor, dt: float, time_constant: Tensor) -> Tensor:
    """First-order lag of a command that is held over each step: mean over the step.

    With y the lagged value at the step's start, the mean is u + (y - u) (tau / dt) (1 - D),
    D = exp(-dt / tau); at first y = u.

    Args:
        u: Command at every sample, held until the next, (..., num_samples, width).
        dt: Time between two samples [s].
        time_constant: tau, () or of the leading axes of u [s].
    """
    decay = torch.exp(-dt / time_constant.clamp(min=_SHORTEST_LAG * dt))[..., None]
    share = (time_constant / dt)[..., None] * (1.0 - decay)
    error, out = torch.zeros_like(u[..., 0, :]), [torch.zeros_like(u[..., 0, :])]
    for fall in (-u.diff(dim=-2)).unbind(-2):
        error = error * decay + fall
        out.append(error)
    return u + torch.stack(torch.broadcast_tensors(*out), -2) * share[..., None]


def held_delayed(u: Tensor, dt: float, delay: Tensor) -> Tensor:
    """A command that is held over each step, late by ``delay`` >= 0: mean over the step.

    Args:
        u: Command at every sample, held until the next, (..., num_samples, width).
        dt: Time between two samples [s].
        delay: () or of the leading axes of u [s].
    """
    last = u.shape[-2] - 1
    steps = torch.arange(last + 1, dtype=u.dtype)
    place = (steps - (delay / dt)[..., None]).clamp(0.0, float(last))
    right = place.detach().ceil().long()
    left = (right - 1).clamp(min=0)
    lead = np.broadcast_shapes(u.shape[:-2], place.shape[:-1])

    def at(index: Tensor) -> Tensor:
        wide = index[..., None].expand(*lead, last + 1, u.shape[-1])
        return u.expand(*lead, *u.shape[-2:]).gather(-2, wide)

    return at(right) - (right - place)[..., None] * (at(right) - at(left))


def dead_band(u: Tensor, half_width: Tensor) -> Tensor:
    """Nothing below ``half_width``, and that much less above it."""
    return u.sign() * (u.abs() - half_width).clamp(min=0.0)


def backlash(u: Tensor, half_gap: Tensor) -> Tensor:
    """Play: the output rests until the input has crossed the gap, then follows at its edge."""
    now = u[0]
    out = [now]
    for target in u[1:]:
        now = torch.maximum(torch.minimum(now, target + half_gap), target - half_gap)
        out.append(now)
    return torch.stack(out)


def saturated(u: Tensor, loss: Tensor, neutral: Tensor) -> Tensor:
    """Limited to (1 - loss) of its greatest departure from ``neutral`` (width,), column by column.

    Args:
        u: Signal in columns, (num_samples, width).
        loss: Share of the greatest departure that is cut off, a scalar () from 0 to 1 [-].
        neutral: Value of each column from which departures count, (width,).
    """
    off = u - neutral
    limit = (1.0 - loss) * off.detach().abs().amax(dim=0)
    return neutral + torch.minimum(torch.maximum(off, -limit), limit)
