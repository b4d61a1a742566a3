"""Points at which a model is simulated, and lines along which it is differentiated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from diffsim.identify.effect import Effect
from diffsim.identify.jacobian import Stencil


@dataclass(frozen=True)
class ModelPoint:
    """Values of base parameters and effects at which a model is simulated.

    Attributes:
        q: Standardized base parameters, (num_base,).
        sizes: Size of each effect, (num_components,) in the effect's unit.
    """

    q: Tensor
    sizes: Mapping[Effect, Tensor]


@dataclass(frozen=True)
class DifferenceLine:
    """One coordinate that a model is differentiated along.

    Attributes:
        stencil: The difference formula for what is cheap to evaluate at its points.
        points: Points at the stencil's offsets along the line.
        effect: Effect whose size the coordinate is; None: the coordinate is a base parameter.
    """

    stencil: Stencil
    points: tuple[ModelPoint, ...]
    effect: Effect | None
