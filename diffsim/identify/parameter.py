"""An imperfectly known number of a model, with what is known of it beforehand."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Parameter:
    """A number with a prior.

    Fits work in the standardised coordinate q, prior q ~ N(0, 1): the value is value + sd q, or
    value exp(sd q) where ``log``, cut at the bounds.

    Attributes:
        name: Field-standard name, such as "youngs_modulus"; nuisances of one run are called
            "offset_x@run_3".
        value: Best guess beforehand, in ``unit``.
        sd: Standard deviation of the prior, in ``unit``; relative where ``log``.
        unit: SI unit, "-" if none.
        log: The logarithm is what is normally distributed; for positive quantities.
        lower, upper: Bounds, in ``unit``.
    """

    name: str
    value: float
    sd: float
    unit: str = "-"
    log: bool = False
    lower: float = -math.inf
    upper: float = math.inf

    def __post_init__(self) -> None:
        if not math.isfinite(self.value) or not self.lower <= self.value <= self.upper:
            raise ValueError(
                f"parameter {self.name}: value {self.value:g} {self.unit} must be finite and "
                f"within [{self.lower:g}, {self.upper:g}]"
            )
        if not (math.isfinite(self.sd) and self.sd > 0.0):
            raise ValueError(f"parameter {self.name}: sd must be above 0, got {self.sd:g}")
        if self.log and self.value <= 0.0:
            raise ValueError(f"parameter {self.name} is logarithmic; its value must be above 0")

    def value_at(self, q: Tensor) -> Tensor:
        """Value [unit] at the standardised coordinate q."""
        raw = self.value * torch.exp(self.sd * q) if self.log else self.value + self.sd * q
        return raw.clamp(self.lower, self.upper)

    def coordinate_of(self, value: float) -> float:
        """Standardised coordinate of a value [unit]."""
        if self.log:
            return math.log(value / self.value) / self.sd
        return (value - self.value) / self.sd
