"""A numerical setting as a candidate cause: how much of a refinement the recordings ask for."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.identify.numerics import Numerics


class NumericalEffect(Effect):
    """S + phi (S(refined) - S): phi near 1 says that the setting is too coarse.

    The model blends the two predictions itself (:meth:`~diffsim.diagnose.SimModel.predict`), as
    other effects act in both.

    Args:
        setting: Such as "time_step".
        refined: The finer settings.
    """

    family, kind, unit, typical, signed = "numerical", "numerical", "-", 1.0, False
    smooth = False  # linear, so that a secant is exact; no model has tangents of it
    also_looks_like = ("damping or stiffness of the material",)

    def __init__(self, setting: str, refined: Numerics):
        vars(self)["name"] = f"coarse_{setting}"  # of the class elsewhere
        self.refined = refined

    def apply(self, scene: Any, size: Tensor, run: Run) -> Any:
        """No scene holds two predictions.

        Raises:
            TypeError: always; ``SimModel.predict`` blends them.
        """
        raise TypeError(f"{self.name} acts on predictions; call SimModel.predict with it")
