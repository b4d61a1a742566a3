"""Effects on a pull test, beyond a neo-Hookean specimen of known length."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Apply, Effect
from diffsim.systems.tensile.model import PullScene, material_of

MATERIALS = ("dragon_skin_10", "dragon_skin_30", "ecoflex_00_10", "ecoflex_00_30", "mold_star_16")
LEAST_ROOM = 0.02  # of 1 - (I_1 - 3) / J_m: beyond, a Gent chain is as good as stretched out


def _per_material(changed: Callable[[PullScene, Tensor], PullScene]) -> Apply:
    """Changes the scene by an amplitude (..., 1), one per material."""
    return partial(_with_own, changed=changed)


def _times(factor: Callable[[PullScene, Tensor], Tensor]) -> Apply:
    """Multiplies the stress by a factor, 1 at the amplitude 0, one amplitude per material."""
    return _per_material(partial(_with_factor, factor=factor))


def _with_own(
    scene: PullScene, size: Tensor, run: Run, *, changed: Callable[[PullScene, Tensor], PullScene]
) -> PullScene:
    return changed(scene, size[..., MATERIALS.index(material_of(run))][..., None])


def _with_factor(
    scene: PullScene, k: Tensor, *, factor: Callable[[PullScene, Tensor], Tensor]
) -> PullScene:
    return scene.with_law(lambda s, stress: stress * factor(s, k))


def _mooney_rivlin(scene: PullScene, k: Tensor) -> Tensor:
    return 1.0 + k / scene.stretch


def _gent(scene: PullScene, k: Tensor) -> Tensor:
    return 1.0 / (1.0 - k * scene.invariant).clamp(min=LEAST_ROOM)


def _yeoh_square(scene: PullScene, k: Tensor) -> Tensor:
    return 1.0 + k * scene.invariant


def _yeoh_cubic(scene: PullScene, k: Tensor) -> Tensor:
    return 1.0 + k * scene.invariant**2


def _power_hardening(scene: PullScene, k: Tensor) -> Tensor:
    return (1.0 + scene.invariant / 3.0) ** k


def _corotated(scene: PullScene, k: Tensor) -> PullScene:
    def blended(s: PullScene, stress: Tensor) -> Tensor:
        el = s.stretch
        other = 2.0 / 3.0 * ((el - 1.0) - (el**-0.5 - 1.0) * el**-1.5)
        return stress + k * (other - (el - el**-2) / 3.0)

    return scene.with_law(blended)


def _relaxation(scene: PullScene, k: Tensor) -> Tensor:
    return 1.0 - k * torch.log1p(torch.from_numpy(scene.run.time_s))


def _damage(scene: PullScene, k: Tensor) -> Tensor:
    return 1.0 - k * (scene.strain / 10.0) ** 2


def _viscous(scene: PullScene, k: Tensor) -> PullScene:
    rate = scene.run.setup["speed_m_s"] / scene.run.setup["gauge_length_m"]
    return scene.with_law(lambda s, stress: stress + 3.0 * k * rate / s.stretch**2)


def _slack(scene: PullScene, k: Tensor) -> PullScene:
    return replace(scene, strain=scene.strain - k)


def _stress_zero(scene: PullScene, k: Tensor) -> PullScene:
    return replace(scene, offset=scene.offset + k)


def _strain_scale(scene: PullScene, size: Tensor, run: Run) -> PullScene:
    return replace(scene, strain=scene.strain * (1.0 - size[..., :1]))


def _load_cell_scale(scene: PullScene, size: Tensor, run: Run) -> PullScene:
    return scene.with_law(lambda s, stress: stress * (1.0 + size[..., :1]))


MOONEY_RIVLIN = Effect(
    name="mooney_rivlin",
    form="Second constant: factor 1 + size / l (C_2 / C_1 = size).",
    family="stress_law",
    kind="material",
    unit="-",
    typical=0.5,
    components=MATERIALS,
    apply=_times(_mooney_rivlin),
)
GENT = Effect(
    name="gent",
    form="Chains of limited length: factor 1 / (1 - size (I_1 - 3)), size = 1 / J_m (Gent 1996).",
    family="stress_law",
    kind="material",
    unit="-",
    typical=0.003,
    signed=False,
    components=MATERIALS,
    apply=_times(_gent),
)
YEOH_SQUARE = Effect(
    name="yeoh_square",
    form="Second Yeoh constant: factor 1 + size (I_1 - 3).",
    family="stress_law",
    kind="material",
    unit="-",
    typical=0.02,
    components=MATERIALS,
    apply=_times(_yeoh_square),
)
YEOH_CUBIC = Effect(
    name="yeoh_cubic",
    form="Second and third Yeoh constants together with ``yeoh_square``: 1 + size (I_1 - 3)^2.",
    family="stress_law",
    kind="material",
    unit="-",
    typical=0.0001,
    components=MATERIALS,
    apply=_times(_yeoh_cubic),
)
POWER_HARDENING = Effect(
    name="power_hardening",
    form="Factor (I_1 / 3)^size: energy ~ I_1^(1 + size) (Lopez-Pamies 2010, one term).",
    family="stress_law",
    kind="material",
    unit="-",
    typical=0.2,
    components=MATERIALS,
    also_looks_like=("Ogden exponent above 2", "yeoh_square at moderate stretch"),
    apply=_times(_power_hardening),
)
COROTATED = Effect(
    name="corotated_share",
    form='Share of the ``"corotated"`` law: 2/3 [(l - 1) - (l^-1/2 - 1) l^-3/2] instead.',
    family="stress_law",
    kind="material",
    unit="-",
    typical=0.5,
    components=MATERIALS,
    apply=_per_material(_corotated),
)
RELAXATION = Effect(
    name="relaxation",
    form="Stress relaxes while the pull lasts: factor 1 - size ln(1 + t / 1 s).",
    family="time",
    kind="material",
    unit="-",
    typical=0.05,
    components=MATERIALS,
    also_looks_like=("softening with strain: at one speed time is strain",),
    apply=_times(_relaxation),
)
DAMAGE = Effect(
    name="damage",
    form="Stress lost with strain: factor 1 - size (strain / 10)^2.",
    family="damage",
    kind="material",
    unit="-",
    typical=0.1,
    signed=False,
    components=MATERIALS,
    also_looks_like=("slip out of the grips", "softening of the Mullins kind"),
    apply=_times(_damage),
)
VISCOUS = Effect(
    name="viscous_stress",
    form="Stress of a rate, 3 size l' / l^2 over E, a viscosity per modulus.",
    family="time",
    kind="material",
    unit="s",
    typical=0.05,
    components=MATERIALS,
    also_looks_like=("zero of the load cell: at one speed a rate is a constant",),
    apply=_per_material(_viscous),
)
SLACK = Effect(
    name="slack",
    form="The specimen was slack for the first ``size`` of strain (negative: preloaded).",
    family="zero",
    kind="sensor",
    unit="-",
    typical=0.02,
    components=MATERIALS,
    also_looks_like=("zero of the crosshead", "specimen that seats itself in the grips"),
    apply=_per_material(_slack),
)
STRESS_ZERO = Effect(
    name="stress_zero",
    form="Stress reads size too much.",
    family="zero",
    kind="sensor",
    unit="Pa",
    typical=1000.0,
    components=MATERIALS,
    apply=_per_material(_stress_zero),
)
STRAIN_SCALE = Effect(
    name="strain_scale",
    form="The gauge length stretches 1 - size of what the crosshead says; the same for all.",
    family="strain",
    kind="sensor",
    unit="-",
    typical=0.1,
    also_looks_like=("wide ends of the specimen that stretch too", "slip out of the grips"),
    apply=_strain_scale,
)
LOAD_CELL_SCALE = Effect(
    name="load_cell_scale",
    form="Stress reads 1 + size times too much: every Young's modulus says the same.",
    family="scale",
    kind="sensor",
    unit="-",
    typical=0.02,
    also_looks_like=("Young's modulus", "width and thickness of the specimen"),
    apply=_load_cell_scale,
)

TENSILE: tuple[Effect, ...] = (
    MOONEY_RIVLIN,
    GENT,
    YEOH_SQUARE,
    YEOH_CUBIC,
    POWER_HARDENING,
    COROTATED,
    RELAXATION,
    DAMAGE,
    VISCOUS,
    SLACK,
    STRESS_ZERO,
    STRAIN_SCALE,
    LOAD_CELL_SCALE,
)
