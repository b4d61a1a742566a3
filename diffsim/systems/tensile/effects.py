"""What a pull test may have beyond a neo-Hookean specimen of known length."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.tensile.model import PullScene, material_of

MATERIALS = ("dragon_skin_10", "dragon_skin_30", "ecoflex_00_10", "ecoflex_00_30", "mold_star_16")
LEAST_ROOM = 0.02  # of 1 - (I_1 - 3) / J_m: beyond, a Gent chain is as good as stretched out


class PullEffect(Effect):
    """One amplitude per material."""

    kind, unit, family = "material", "-", "stress law"
    components: ClassVar[tuple[str, ...]] = MATERIALS

    def apply(self, scene: PullScene, size: Tensor, run: Run) -> Any:
        return self.changed(scene, size[..., MATERIALS.index(material_of(run))][..., None])

    def changed(self, scene: PullScene, k: Tensor) -> PullScene:
        """The scene at the amplitude k, (..., 1)."""
        return scene.with_law(lambda s, stress: stress * self.factor(s, k))

    def factor(self, scene: PullScene, k: Tensor) -> Tensor:
        """Factor on the stress, 1 at k = 0."""
        raise NotImplementedError


class MooneyRivlin(PullEffect):
    """Second constant: factor 1 + size / l (C_2 / C_1 = size)."""

    name, typical = "mooney_rivlin", 0.5

    def factor(self, scene: PullScene, k: Tensor) -> Tensor:
        return 1.0 + k / scene.stretch


class Gent(PullEffect):
    """Chains of limited length: factor 1 / (1 - size (I_1 - 3)), size = 1 / J_m (Gent 1996)."""

    name, typical, signed = "gent", 0.003, False

    def factor(self, scene: PullScene, k: Tensor) -> Tensor:
        return 1.0 / (1.0 - k * scene.invariant).clamp(min=LEAST_ROOM)


class YeohSquare(PullEffect):
    """Second Yeoh constant: factor 1 + size (I_1 - 3)."""

    name, typical = "yeoh_square", 0.02

    def factor(self, scene: PullScene, k: Tensor) -> Tensor:
        return 1.0 + k * scene.invariant


class YeohCubic(PullEffect):
    """Second and third Yeoh constants together with ``yeoh_square``: 1 + size (I_1 - 3)^2."""

    name, typical = "yeoh_cubic", 1e-4

    def factor(self, scene: PullScene, k: Tensor) -> Tensor:
        return 1.0 + k * scene.invariant**2


class PowerHardening(PullEffect):
    """Factor (I_1 / 3)^size: energy ~ I_1^(1 + size) (Lopez-Pamies 2010, one term)."""

    name, typical = "power_hardening", 0.2
    also_looks_like = ("Ogden exponent above 2", "yeoh_square at moderate stretch")

    def factor(self, scene: PullScene, k: Tensor) -> Tensor:
        return (1.0 + scene.invariant / 3.0) ** k


class Corotated(PullEffect):
    """Share of the ``"corotated"`` law: 2/3 [(l - 1) - (l^-1/2 - 1) l^-3/2] instead."""

    name, typical = "corotated_share", 0.5

    def changed(self, scene: PullScene, k: Tensor) -> PullScene:
        def blended(s: PullScene, stress: Tensor) -> Tensor:
            el = s.stretch
            other = 2.0 / 3.0 * ((el - 1.0) - (el**-0.5 - 1.0) * el**-1.5)
            return stress + k * (other - (el - el**-2) / 3.0)

        return scene.with_law(blended)


class Relaxation(PullEffect):
    """Stress relaxes while the pull lasts: factor 1 - size ln(1 + t / 1 s)."""

    name, typical, family = "relaxation", 0.05, "time"
    also_looks_like = ("softening with strain: at one speed time is strain",)

    def factor(self, scene: PullScene, k: Tensor) -> Tensor:
        return 1.0 - k * torch.log1p(torch.from_numpy(scene.run.time_s))


class Damage(PullEffect):
    """Stress lost with strain: factor 1 - size (strain / 10)^2."""

    name, typical, family, signed = "damage", 0.1, "damage", False
    also_looks_like = ("slip out of the grips", "softening of the Mullins kind")

    def factor(self, scene: PullScene, k: Tensor) -> Tensor:
        return 1.0 - k * (scene.strain / 10.0) ** 2


class Viscous(PullEffect):
    """Stress of a rate, 3 size l' / l^2 over E, a viscosity per modulus."""

    name, typical, family, unit = "viscous_stress", 0.05, "time", "s"
    also_looks_like = ("zero of the load cell: at one speed a rate is a constant",)

    def changed(self, scene: PullScene, k: Tensor) -> PullScene:
        rate = scene.run.setup["speed_m_s"] / scene.run.setup["gauge_length_m"]
        return scene.with_law(lambda s, stress: stress + 3.0 * k * rate / s.stretch**2)


class Slack(PullEffect):
    """The specimen was slack for the first ``size`` of strain (negative: preloaded)."""

    name, typical, family, kind = "slack", 0.02, "zero", "sensor"
    also_looks_like = ("zero of the crosshead", "specimen that seats itself in the grips")

    def changed(self, scene: PullScene, k: Tensor) -> PullScene:
        return replace(scene, strain=scene.strain - k)


class LoadCellZero(PullEffect):
    """Stress reads size too much."""

    name, typical, family, kind, unit = "load_cell_zero", 1000.0, "zero", "sensor", "Pa"

    def changed(self, scene: PullScene, k: Tensor) -> PullScene:
        return replace(scene, offset=scene.offset + k)


class StrainScale(PullEffect):
    """The gauge length stretches 1 - size of what the crosshead says; the same for all."""

    name, typical, family, kind = "strain_scale", 0.1, "strain", "sensor"
    components = ("size",)
    also_looks_like = ("wide ends of the specimen that stretch too", "slip out of the grips")

    def apply(self, scene: PullScene, size: Tensor, run: Run) -> Any:
        return replace(scene, strain=scene.strain * (1.0 - size[..., :1]))


class LoadCellScale(PullEffect):
    """Stress reads 1 + size times too much: every Young's modulus says the same."""

    name, typical, family, kind = "load_cell_scale", 0.02, "scale", "sensor"
    components = ("size",)
    also_looks_like = ("Young's modulus", "width and thickness of the specimen")

    def apply(self, scene: PullScene, size: Tensor, run: Run) -> Any:
        return scene.with_law(lambda s, stress: stress * (1.0 + size[..., :1]))


TENSILE: tuple[type[PullEffect], ...] = (
    MooneyRivlin,
    Gent,
    YeohSquare,
    YeohCubic,
    PowerHardening,
    Corotated,
    Relaxation,
    Damage,
    Viscous,
    Slack,
    LoadCellZero,
    StrainScale,
    LoadCellScale,
)
