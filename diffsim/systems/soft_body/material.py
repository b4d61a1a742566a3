"""Causes in the material of a soft body."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from diffsim.core.errors import DiffsimError
from diffsim.data.study import Run
from diffsim.systems.soft_body.scene import Force, Moment, SoftScene

# Branches of the loss factor: half a decade apart, flat from about 0.6 to 50 Hz.
_BRANCH_HZ = (0.316, 1.0, 3.16, 10.0, 31.6, 100.0)
_CREEP_HZ = (0.316, 0.0316, 0.00316)  # a decade apart: half a second to a minute
_STRENGTH = 2.0 / math.pi * math.log(10.0) / 2.0  # of a branch, per loss factor


_SOLID = ("youngs_modulus", "poissons_ratio")


def lose_in_motion(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """Loss factor that does not depend on the frequency: damping ratio size / 2.

    Maxwell branches of equal strength, half a decade apart: the solid's force f is joined by
    sum_k g (f - m_k), tau_k m_k' = f - m_k, with g = (2 / pi) ln(spacing) size. Long loads relax:
    the stiffness is E at rest and E (1 + size (2 / pi) ln(...)) in fast motion. Memory is kept in
    world axes, so rotations of the body must stay small (a bending bar, not a tumbling one).
    """
    return _relax_branches(scene, _BRANCH_HZ, _STRENGTH * size[0])


def creep(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """Compliance that grows by the share size per decade of time, from half a second to minutes.

    Slow Maxwell branches, one per decade, of strength size: slower than any swing, so that no
    damping comes with them. The stiffness is E for loads that last, E (1 + 3 size) in motion.
    """
    return _relax_branches(scene, _CREEP_HZ, size[0])


def _relax_branches(scene: SoftScene, branch_hz: tuple[float, ...], strength: Tensor) -> SoftScene:
    """Maxwell branches of equal strength beside the solid."""
    # the branches' instantaneous part is stiffness, which the implicit step takes
    young = scene.number("youngs_modulus")
    stiff = scene.with_parameter("youngs_modulus", young * (1.0 + len(branch_hz) * strength))
    relaxed = {"youngs_modulus": young, **scene.relaxed}
    return stiff.changed(relaxed=relaxed).with_hook(lambda: _Relaxation(scene, branch_hz, strength))


class _Relaxation(Force):
    """- sum_k g m_k with m_k following the solid's force, exact for straight lines of it."""

    leading_axes, reads = True, _SOLID

    def __init__(self, plain: SoftScene, branch_hz: tuple[float, ...], strength: Tensor):
        self._plain, self._strength = plain, strength
        self._solid = plain.solid_force()
        self._tau = 1.0 / (2.0 * math.pi * torch.tensor(branch_hz, dtype=torch.float64))
        self._memory: Tensor | None = None
        self._before: Tensor | None = None
        self._per_step: dict[float, tuple[Tensor, Tensor]] = {}

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        force, _ = self._solid(moment.x)
        if self._memory is None or self._before is None:
            self._memory = force.expand(len(self._tau), *force.shape)
        else:
            if moment.dt not in self._per_step:
                steps = (self._tau / moment.dt).reshape(-1, *(1 for _ in force.shape))
                self._per_step = {moment.dt: (steps, torch.exp(-1.0 / steps))}
            steps, decay = self._per_step[moment.dt]
            steady = steps * (force - self._before)
            error = torch.addcmul(steady, self._before - self._memory - steady, decay)
            self._memory = force - error
        self._before = force
        # minus the branches' share of E, plus (f - m): together g (f - m) beside the plain solid
        return -self._strength * self._memory.sum(0)

    def factor_of(self, other: Force) -> Tensor | None:
        """Forces of solids that differ in the size of E alone are alike, and so are memories."""
        if not isinstance(other, _Relaxation) or not torch.equal(self._tau, other._tau):
            return None
        a, b = self._plain, other._plain
        if a.body is not b.body:
            return None
        if not torch.equal(a.number("poissons_ratio"), b.number("poissons_ratio")):
            return None
        modulus, others = a.number("youngs_modulus"), b.number("youngs_modulus")
        mean = self._strength * modulus.mean()
        if modulus.shape != others.shape or not bool(mean > 0.0):
            return None
        if not torch.allclose(modulus / modulus.mean(), others / others.mean(), rtol=1e-14, atol=0):
            return None
        return other._strength * others.mean() / mean


def stiffen_by_strain(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """E (1 + size e^2), e^2 the body's mean square strain 2 U / (E V)."""
    return scene.with_hook(lambda: _Stiffening(size[0]))


class _Stiffening(Force):
    """The force of the energy U + size U^2 / (E V) beside that of U."""

    leading_axes, of_state, reads = True, True, _SOLID

    def __init__(self, size: Tensor):
        self._size = size
        self._solid: Callable[[Tensor], tuple[Tensor, Tensor]] | None = None

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        self._solid = self._solid or scene.solid_force()
        force, strain_squared = self._solid(moment.x)
        return self._size * strain_squared[..., None, None] * force


def lose_stiffness(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """E (1 - sum_i size_i hat_i) with straight-sided hats at the ends and the middle of the body.

    Places are shares of its length along its longest axis.
    """
    mesh = scene.body.mesh
    spread = mesh.x_rest.amax(0) - mesh.x_rest.amin(0)
    axis = int(spread.argmax())
    center = mesh.x_rest[mesh.elements][:, :, axis].mean(1)
    share = (center - mesh.x_rest[:, axis].min()) / spread[axis]
    places = torch.tensor([0.0, 0.5, 1.0], dtype=share.dtype)
    hats = (1.0 - 2.0 * (share[:, None] - places).abs()).clamp(min=0.0)
    # at the tips of the hats, which cells of any mesh may reach
    _require_stiffness(1.0 - size)
    return _scale_stiffness(scene, 1.0 - hats @ size)


def drift_with_order(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """E (1 + size order), order the place of the run in the series."""
    return _scale_stiffness(scene, 1.0 + size[0] * run.order)


def _scale_stiffness(scene: SoftScene, factor: Tensor) -> SoftScene:
    """The scene with E times a factor, one or per element."""
    _require_stiffness(factor)
    return scene.with_parameter("youngs_modulus", scene.number("youngs_modulus") * factor)


def _require_stiffness(factor: Tensor) -> None:
    """Refuse a factor on E that is not positive; a search then takes a smaller step.

    Raises:
        DiffsimError: it is not.
    """
    if not bool((factor > 0.0).all()):
        raise DiffsimError(f"no stiffness: E times {float(factor.min()):.3g}; the size is too far")
