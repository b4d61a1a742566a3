"""Derivatives of a predicted record in standardized coordinates.

By the simulator's own tangents, by differences of simulations, or by torch's forward mode.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import Array
from diffsim.core.check import require_choice, require_number
from diffsim.core.checked import checked

PredictMany = Callable[[Sequence[Tensor]], Tensor]  # K points -> (K, ...)
METHODS = ("auto", "differences", "forward_mode")


@dataclass(frozen=True)
class Stencil:
    """A difference formula: the slope at 0 is the sum of weight * f(offset)."""

    # points of the formula along one coordinate, in prior standard deviations
    offsets: tuple[float, ...]
    weights: tuple[float, ...]  # weights of the values at the offsets, equally many

    @classmethod
    def central(cls, h: float) -> Stencil:
        """Central difference, of second order."""
        return cls((h, -h), (0.5 / h, -0.5 / h))

    @classmethod
    def one_sided(cls, h: float) -> Stencil:
        """Second order, from points at and above 0; at and below for a negative h."""
        return cls((0.0, h, 2.0 * h), (-1.5 / h, 2.0 / h, -0.5 / h))

    @classmethod
    def chord(cls, h: float) -> Stencil:
        """The slope of the chord from 0 to h."""
        return cls((0.0, h), (-1.0 / h, 1.0 / h))


Tangents = Callable[[Mapping[int, Stencil]], "tuple[Array, Array] | None"]


@checked
@dataclass(frozen=True, kw_only=True)
class Jacobian:
    """Method and step of the derivatives of a prediction.

    Attributes:
        method: ``"auto"``: by the model's own tangents where it has them, else as
            ``"differences"``: of simulations, for every simulator. ``"forward_mode"``: torch's
            dual numbers, where all operations of the scene support them.
        step: Step of the differences, in prior standard deviations. Central ones are wrong by about
            step^2 / 6 of the third derivative; a solver's tolerance is amplified by 1 / step.
    """

    method: str = "auto"
    step: float = 1e-2

    def __post_init__(self) -> None:
        require_choice("method", self.method, METHODS)
        require_number("step", self.step, above=0.0)

    @checked(kinds_only=True)
    def columns(
        self,
        many: PredictMany,
        at: Tensor,
        stencils: Mapping[int, Stencil],
        *,
        quick: Collection[int] = (),
        tangents: Tangents | None = None,
    ) -> tuple[Array, Array]:
        """Prediction and its derivatives along some coordinates.

        Args:
            many: Coordinates (n,) each -> predictions of equal shape.
            at: Point to differentiate at, (n,).
            stencils: Difference formulas by coordinate.
            quick: Those of them whose slopes need no simulations.
            tangents: The model's own: stencils by coordinate -> the flattened prediction and one
                column each, or None where it has none.

        Returns:
            (num_outputs,) the flattened prediction, and (num_outputs, len(stencils)).
        """
        if self.method == "forward_mode":
            return _forward_mode(many, at, list(stencils))
        given = None
        if self.method == "auto" and tangents is not None and quick:
            given = tangents({i: s for i, s in stencils.items() if i in quick})
        if given is None:
            return _differences(many, at, stencils)
        here, columns = given
        slow = {i: s for i, s in stencils.items() if i not in quick}
        if not slow:
            return here, columns
        by_simulation = iter(_differences(many, at, slow)[1].T)
        by_tangents = iter(columns.T)
        return here, np.column_stack(
            [next(by_tangents if i in quick else by_simulation) for i in stencils]
        )


def _differences(
    many: PredictMany, at: Tensor, stencils: Mapping[int, Stencil]
) -> tuple[Array, Array]:
    """Differences of simulations, all in one call."""
    with torch.no_grad():
        rows = many(difference_points(at, stencils).unbind()).detach().numpy()
    return differences(rows, stencils)


def difference_points(at: Tensor, stencils: Mapping[int, Stencil]) -> Tensor:
    """Points of difference formulas, (K, n); the first one, ``at``, serves every coordinate.

    Args:
        at: Point to differentiate at, (n,).
        stencils: Difference formulas by coordinate.
    """
    moved = [(i, o) for i, stencil in stencils.items() for o in stencil.offsets if o != 0.0]
    points = np.repeat(at.detach().numpy()[None], 1 + len(moved), axis=0)
    for k, (i, offset) in enumerate(moved, 1):
        points[k, i] += offset
    return torch.from_numpy(points)


def differences(rows: Array, stencils: Mapping[int, Stencil]) -> tuple[Array, Array]:
    """Prediction and its derivatives by difference formulas.

    Args:
        rows: Predictions at ``difference_points``, (K, ...), num_outputs of each.
        stencils: Difference formulas by coordinate.

    Returns:
        (num_outputs,) and (num_outputs, len(stencils)).
    """
    rows = rows.reshape(len(rows), -1)
    out, k = np.zeros((len(stencils), rows[0].size)), 1
    with np.errstate(invalid="ignore", over="ignore"):  # whoever asks refuses infinities
        for j, stencil in enumerate(stencils.values()):
            for offset, weight in zip(stencil.offsets, stencil.weights, strict=True):
                out[j] += weight * (rows[0] if offset == 0.0 else rows[k])
                k += offset != 0.0
    return rows[0], out.T


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
