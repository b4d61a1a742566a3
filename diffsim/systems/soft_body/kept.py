"""What forces need in every step and compute once: values of a scene, and values of time alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import torch
from torch import Tensor

from diffsim.systems.soft_body.scene import Moment, SoftScene

_Value = TypeVar("_Value")


def ratio(one: Tensor, other: Tensor) -> Tensor | None:
    """f with other = f one, of tensors of one shape; None: they are no multiples."""
    if one.shape != other.shape:
        return None
    factor = (one * other).sum() / (one * one).sum()
    return factor if torch.allclose(other, factor * one, rtol=1e-14, atol=0.0) else None


class OfScene(Generic[_Value]):
    """A value that depends on the scene alone, of the scene that was last asked for."""

    def __init__(self, compute: Callable[[SoftScene], _Value]):
        self._compute = compute
        self._known: tuple[SoftScene, _Value] | None = None

    def __call__(self, scene: SoftScene) -> _Value:
        if self._known is None or self._known[0] is not scene:
            self._known = scene, self._compute(scene)
        return self._known[1]


class OfTime:
    """A signal of time alone, computed for many steps at a time.

    Args:
        signal: Values (num_times, ...) at times (num_times,) [s]; each depends on its own time.
    """

    def __init__(self, signal: Callable[[Tensor], Tensor]):
        self._signal = signal
        self._first, self._dt = 0.0, 0.0
        self._times: list[float] = []
        self._rows: list[Tensor] = []

    def __call__(self, moment: Moment) -> Tensor:
        """The signal (...) at a moment."""
        if not self._times:
            self._first, self._dt = moment.time, moment.dt
        k = round((moment.time - self._first) / self._dt)
        if k == len(self._times):
            steps = torch.arange(k, k + 256, dtype=torch.float64)  # computed at a time
            times = self._first + self._dt * steps
            self._times += times.tolist()
            self._rows += self._signal(times).unbind()
        # times of steps are computed as those of moments are: what differs is on another clock
        if 0 <= k < len(self._times) and self._times[k] == moment.time:
            return self._rows[k]
        return self._signal(torch.tensor([moment.time], dtype=torch.float64))[0]
