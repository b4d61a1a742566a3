"""Points at which a model is simulated, and lines along which it is differentiated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from diffsim.identify.effect import Effect
from diffsim.identify.jacobian import Stencil


@dataclass(frozen=True)
class ModelPoint:
    """Values of base parameters and effects at which a model is simulated."""

    q: Tensor  # standardized base parameters, (num_base,)
    sizes: Mapping[Effect, Tensor]  # size of each effect, (num_components,) in the effect's unit


@dataclass(frozen=True)
class DifferenceLine:
    """One coordinate that a model is differentiated along."""

    stencil: Stencil  # the difference formula for what is cheap to evaluate at its points
    points: tuple[ModelPoint, ...]  # points at the stencil's offsets along the line
    # effect whose size the coordinate is; None: the coordinate is a base parameter
    effect: Effect | None
