"""Uniaxial tension of an incompressible solid in closed form.

Plain: the library's ``"neo_hookean"`` (``diffsim.soft.materials``) for J = 1, free sides:
engineering stress = E/3 (l - l^-2), l = 1 + engineering strain.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffsim.data.importers.silicone_tensile import LAW_SHARE, STRESS_SD_PA
from diffsim.data.study import Run
from diffsim.identify import Parameter
from diffsim.identify.model import Numerics, SimModel

#: (scene, engineering stress per Young's modulus) -> the same
Law = Callable[["PullScene", Tensor], Tensor]


def material_of(run: Run) -> str:
    """Material of a part of a pull: "dragon_skin_10", ..."""
    return run.name.rsplit("_", 1)[0]


@dataclass(frozen=True, eq=False)
class PullScene:
    """One part of a pull test.

    Attributes:
        run: Recorded part of a pull.
        youngs_modulus: Young's modulus, () or (K,) [Pa].
        strain: (..., num_samples) engineering strain of the gauge length.
        laws: Functions by which effects change the stress per Young's modulus, in this order.
        offset: (...) [Pa], added to the stress that is read.
    """

    run: Run
    youngs_modulus: Tensor
    strain: Tensor
    laws: tuple[Law, ...] = ()
    offset: Tensor | float = 0.0

    def with_law(self, law: Law) -> PullScene:
        """A copy with one more change of the stress."""
        return replace(self, laws=(*self.laws, law))

    @property
    def stretch(self) -> Tensor:
        """l, (..., num_samples), at least 1: slack carries nothing."""
        return 1.0 + self.strain.clamp(min=0.0)

    @property
    def invariant(self) -> Tensor:
        """First invariant of the stretch, less 3: I_1 - 3 = l^2 + 2/l - 3."""
        return self.stretch**2 + 2.0 / self.stretch - 3.0

    def simulate(self) -> Tensor:
        """(..., num_samples, 1) engineering stress in units of its scatter."""
        stress = (self.stretch - self.stretch**-2) / 3.0
        for law in self.laws:
            stress = law(self, stress)
        stress = self.youngs_modulus[..., None] * stress + self.offset
        return torch.asinh(LAW_SHARE / STRESS_SD_PA * stress)[..., None] / LAW_SHARE


def pull_model(runs: tuple[Run, ...]) -> SimModel:
    """One Young's modulus per material."""
    materials = dict.fromkeys(material_of(r) for r in runs)

    def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> PullScene:
        strain = torch.from_numpy(run.command["engineering_strain"])
        return PullScene(run, values[f"youngs_modulus_{material_of(run)}"], strain)

    base = [Parameter(f"youngs_modulus_{m}", 2e5, 1.0, "Pa", log=True) for m in materials]
    return SimModel(build, base, "neo-Hookean specimen", batched=True)
