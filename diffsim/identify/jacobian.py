"""Derivatives of a predicted record in standardised coordinates: differences, or forward mode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim._check import require_choice, require_number

Array = NDArray[np.float64]
PredictMany = Callable[[Sequence[Tensor]], Tensor]  # K points -> (K, ...)
METHODS = ("differences", "forward_mode")


@dataclass(frozen=True, kw_only=True)
class Jacobian:
    """How to differentiate a prediction.

    Attributes:
        method: ``"differences"``: works for every simulator. ``"forward_mode"``: torch's dual
            numbers, where all operations of the scene support them.
        step: Of the differences, in prior standard deviations. Central ones are wrong by about
            step^2 / 6 of the third derivative; a solver's tolerance is amplified by 1 / step.
    """

    method: str = "differences"
    step: float = 1e-2

    def __post_init__(self) -> None:
        require_choice("method", self.method, METHODS)
        require_number("step", self.step, above=0.0)

    def columns(
        self,
        many: PredictMany,
        at: Tensor,
        idx: Sequence[int],
        *,
        one_sided: Sequence[bool],
        secant: Sequence[float],
    ) -> tuple[Array, Array]:
        """Prediction and derivatives.

        Args:
            many: Coordinates (n,) each -> predictions of equal shape.
            at: (n,) where.
            idx: The coordinates to differentiate.
            one_sided: (n,) True where the coordinate cannot go below its place: second-order
                differences upwards.
            secant: (n,) above 0: the slope of the chord from here to here + secant.

        Returns:
            (num_outputs,) the flattened prediction, and (num_outputs, len(idx)).
        """
        if self.method == "forward_mode":
            return _forward_mode(many, at, idx)
        points, h = [at], self.step
        for i in idx:
            for offset in _stencil(one_sided[i], secant[i], h):
                moved = at.clone()
                moved[i] += offset
                points.append(moved)
        with torch.no_grad():
            rows = many(points).detach().numpy().reshape(len(points), -1)
        here, out, k = rows[0], np.zeros((rows[0].size, len(idx))), 1
        for j, i in enumerate(idx):
            if secant[i] > 0.0:
                out[:, j] = (rows[k] - here) / secant[i]
                k += 1
            elif one_sided[i]:
                out[:, j] = (4.0 * rows[k] - rows[k + 1] - 3.0 * here) / (2.0 * h)
                k += 2
            else:
                out[:, j] = (rows[k] - rows[k + 1]) / (2.0 * h)
                k += 2
        return here, out


def _stencil(one_sided: bool, secant: float, h: float) -> tuple[float, ...]:
    if secant > 0.0:
        return (secant,)
    return (h, 2.0 * h) if one_sided else (h, -h)


def _forward_mode(many: PredictMany, at: Tensor, idx: Sequence[int]) -> tuple[Array, Array]:
    columns, here = [], None
    for i in idx:
        direction = torch.zeros_like(at)
        direction[i] = 1.0
        value, column, *_ = torch.func.jvp(lambda x: many([x])[0], (at,), (direction,))
        here = value.detach().numpy().ravel()
        columns.append(column.detach().numpy().ravel())
    if here is None:
        with torch.no_grad():
            here = many([at])[0].numpy().ravel()
    return here, np.column_stack(columns) if columns else np.zeros((here.size, 0))
