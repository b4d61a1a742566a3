"""A numerical setting as a candidate cause: how much of a refinement the recordings ask for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NoReturn

from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.identify.numerics import Numerics


@dataclass(frozen=True, kw_only=True, eq=False)
class NumericalEffect(Effect):
    """S + phi (S(refined) - S): phi near 1 says that the setting is too coarse.

    The model blends the two predictions itself (:meth:`~diffsim.identify.SimModel.predict`), as
    other effects act in both.

    Attributes:
        refined: Factors on time step, mesh and tolerance of the finer simulation.
    """

    refined: Numerics


def coarse(setting: str, refined: Numerics) -> NumericalEffect:
    """The candidate "coarse_SETTING".

    Args:
        setting: Name of the numerical setting, such as "time_step".
        refined: Factors on time step, mesh and tolerance of the finer simulation.
    """
    return NumericalEffect(
        name=f"coarse_{setting}",
        form=f"The {setting} is too coarse: 1 asks for the refined one.",
        family="numerical",
        kind="numerical",
        unit="-",
        typical=1.0,
        signed=False,
        smooth=False,  # linear, so that a secant is exact; no model has tangents of it
        also_looks_like=("damping or stiffness of the material",),
        apply=_refuse,
        refined=refined,
    )


def _refuse(scene: Any, size: Tensor, run: Run) -> NoReturn:
    raise TypeError("a numerical effect acts on predictions; call SimModel.predict with it")
