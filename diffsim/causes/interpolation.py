"""Values between the samples of signals in columns, (num_samples, width), evenly spaced."""

from __future__ import annotations

import torch
from torch import Tensor


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
    beyond = (place - place.clamp(0.0, float(last)))[:, None]  # at either end its slope is zero
    return inside + beyond.clamp(max=0.0) * slopes[0] + beyond.clamp(min=0.0) * slopes[-1]


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
