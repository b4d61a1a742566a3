"""Numerical settings relative to a model's own, and coarse ones as candidate causes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NoReturn

from torch import Tensor

from diffsim.core.checked import checked
from diffsim.data.study import Run
from diffsim.identify.effect import Effect


@checked(kinds_only=True)
@dataclass(frozen=True)
class Numerics:
    """Factors on the model's own settings.

    Attributes:
        time_step: Factor on the time step [-].
        mesh: Factor on the cell size [-].
        tolerance: Factor on the tolerances of the solvers [-].
    """

    time_step: float = 1.0
    mesh: float = 1.0
    tolerance: float = 1.0

    @checked(kinds_only=True)
    def refined(self, finer: Numerics) -> Numerics:
        """Product of both sets of factors."""
        return Numerics(
            self.time_step * finer.time_step,
            self.mesh * finer.mesh,
            self.tolerance * finer.tolerance,
        )


REFINEMENTS = {
    "time_step": Numerics(time_step=0.5),
    "mesh": Numerics(mesh=0.5),
    "tolerance": Numerics(tolerance=0.1),
}
"""What the numerics gate refines, one setting at a time."""


@checked(kinds_only=True)
@dataclass(frozen=True, kw_only=True, eq=False)
class NumericalEffect(Effect):
    """S + phi (S(refined) - S): phi near 1 says that the setting is too coarse.

    The model blends the two predictions itself (:meth:`~diffsim.identify.SimModel.predict`), as
    other effects act in both.

    Attributes:
        refined: Factors on time step, mesh and tolerance of the finer simulation.
    """

    refined: Numerics


@checked
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
