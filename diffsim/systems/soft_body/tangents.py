"""A soft scene's prediction and its derivatives along many lines, in one sweep.

What is cheap is differenced between the scenes at a line's points: parameters, activations, hooks'
forces, clocks and output maps. The motion itself is not simulated again: its tangents come from
:func:`diffsim.soft.rollout_tangents`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from diffsim import soft
from diffsim.soft.integrators import IMPLICIT
from diffsim.soft.physics_tangent import difference_physics, stack_physics
from diffsim.systems.soft_body.line import LinePoints, OwnedScene, SceneLine, same_surroundings
from diffsim.systems.soft_body.moving_forces import MovingForces
from diffsim.systems.soft_body.scene import SoftScene


def scene_tangents(base: OwnedScene, lines: Sequence[SceneLine]) -> tuple[Tensor, Tensor] | None:
    """Prediction (num_samples, num_channels) and derivatives (K, ...) of a scene.

    None where the scene has no tangents: another kind, or explicit steps. Lines along which the
    scene becomes another kind are simulated.
    """
    scene = base.scene
    if scene.body.integrator not in IMPLICIT or type(scene) is not SoftScene:
        return None
    if scene.obstacles or scene.pressurize is not None:
        return None
    alike = [n for n in lines if _are_alike(scene, n)]
    observed, tangents = motion_tangents(base, alike)
    computed = {
        line: line.difference(partial(_shift_channels, observed, tangent))
        for line, tangent in zip(alike, tangents, strict=True)
    }
    for line in lines:
        if line not in computed:
            computed[line] = line.difference(lambda o, s: s.simulate())
    here = scene.channels(observed)
    columns = [computed[n] for n in lines]
    return here, torch.stack(columns) if columns else here.new_zeros(0, *here.shape)


def _shift_channels(observed: Tensor, tangent: Tensor, offset: float, scene: SoftScene) -> Tensor:
    """Channels of a scene a little along a line."""
    return scene.channels(observed + offset * tangent)


def motion_tangents(base: OwnedScene, lines: Sequence[SceneLine]) -> tuple[Tensor, list[Tensor]]:
    """Observed channels of a scene at every step, and their tangent along each line."""
    motion = _Motion(base, lines)
    observed, tangent = motion.observed()
    still = torch.zeros_like(observed)
    at = [motion.place.get(k) for k in range(len(lines))]
    return observed, [still if k is None else tangent[:, k] for k in at]


def _are_alike(scene: SoftScene, line: SceneLine) -> bool:
    return all(
        type(s) is SoftScene
        and s.body is scene.body
        and s.start == scene.start
        and not s.obstacles
        and (s.water is None) == (scene.water is None)
        and s.is_commanded == scene.is_commanded
        for s in (p.scene for p in line.points)
    )


class _Motion:
    """The motion of a scene and its tangents along those lines that move it.

    Args:
        base: Scene that the lines start from.
        lines: All lines, those that do not move the body included.
    """

    def __init__(self, base: OwnedScene, lines: Sequence[SceneLine]):
        self._scene = scene = base.scene
        every = [scene, *(p.scene for n in lines for p in n.points)]
        self._num_steps = max(s.num_steps() for s in every)
        self._activations = scene.activations(self._num_steps)
        rates = [self._find_activation_rate(n) for n in lines]
        moving = [k for k, n in enumerate(lines) if rates[k] is not None or _find_moves(base, n)]
        self.place = {k: i for i, k in enumerate(moving)}
        self._lines = [lines[k] for k in moving]
        self._activation_rates = self._stack_rates([rates[k] for k in moving])
        scenes = [scene, *(p.scene for n in self._lines for p in n.points)]
        forced = any(s.makers or s.water is not None for s in scenes)
        self._forces = MovingForces(base, self._lines) if forced else None
        self._physics = scene.body.physics(**scene.parameters)

    def observed(self) -> tuple[Tensor, Tensor]:
        """Channels at every step, (num_steps + 1, c), and their tangents (num_steps + 1, K, c)."""
        scene, activations, forces = self._scene, self._activations, self._forces
        first = None if activations is None else activations[0]
        start = scene.initial_state(first, self._physics)
        signals: dict[str, Any] = {
            "external_force": None if forces is None else forces.total,
            "activation": None if activations is None else lambda k, state: activations[k],
            "physics": self._physics,
        }
        body, count, steps = scene.body, len(self._lines), self._num_steps
        if not count:
            x = soft.rollout(body, start, steps, keep=lambda s: scene.observe(s.x), **signals).x
            return x, x.new_zeros(len(x), 0, x.shape[-1])
        moved = self._activation_rates
        rate_of = _PhysicsRates()
        changing = stack_physics([rate_of(n) for n in self._lines])
        directions = soft.Directions(
            x=self._stack_start_rates(start, first, changing),
            v=self._stack_rates_of("start_velocity"),
            external_force=None if forces is None else forces.rates,
            activation=None if moved is None else lambda k, state, tangent: moved[:, k],
            physics=changing,
        )
        observer = _Observer(scene, self._lines)
        computed = soft.rollout_tangents(
            body, start, steps, count, directions, keep=observer, **signals
        )
        return computed.x, computed.tangent

    def _find_activation_rate(self, line: SceneLine) -> Tensor | None:
        """(num_steps, num_muscles), or None where the commands stay as they are."""
        computed = [p.scene.activations(self._num_steps) for p in line.points]
        given = [a for a in computed if a is not None]
        if not given:
            return None
        rate = torch.tensordot(
            torch.tensor(line.stencil.weights, dtype=torch.float64), torch.stack(given), 1
        )
        return rate if bool(rate.any()) else None

    def _stack_rates(self, rates: Sequence[Tensor | None]) -> Tensor | None:
        """(K, num_steps, num_muscles)."""
        if self._activations is None or all(r is None for r in rates):
            return None
        none = torch.zeros_like(self._activations)
        return torch.stack([none if r is None else r for r in rates])

    def _stack_rates_of(self, name: str) -> Tensor | None:
        """(K, V, 3) of a field of the scenes, or None where there is none."""
        if getattr(self._scene, name) is None:
            return None
        return torch.stack([n.difference(lambda o, s: getattr(s, name)) for n in self._lines])

    def _stack_start_rates(
        self, start: soft.State, first: Tensor | None, changing: soft.Physics
    ) -> Tensor | None:
        """(K, V, 3), or None where the body starts in its rest shape."""
        scene, moved = self._scene, self._activation_rates
        if scene.start == "rest":
            return None
        if scene.start == "given":
            return self._stack_rates_of("start_position")
        if self._forces is None:
            directions = soft.Directions(
                activation=None if moved is None else moved[:, 0],
                physics=changing,
            )
            return soft.static_tangents(
                scene.body,
                start.x,
                len(self._lines),
                directions,
                activation=first,
                physics=self._physics,
            )

        def at(offset: float, scene: SoftScene) -> Tensor:
            activations = scene.activations(1)
            first = None if activations is None else activations[0]
            return scene.initial_state(first, scene.body.physics(**scene.parameters)).x

        return torch.stack([n.difference(at) for n in self._lines])


def _find_moves(base: OwnedScene, line: SceneLine) -> bool:
    """Whether a line changes the motion or how it is observed, commands apart."""
    return any(
        not same_surroundings(base.scene, p.scene, None)
        or (line.effect is not None and line.effect in p.owners)
        or p.scene.observe != base.scene.observe
        for p in line.points
    )


class _PhysicsRates:
    """How parameters change along lines; lines with the same parameters share what is computed."""

    def __init__(self) -> None:
        self._made: dict[tuple[object, ...], soft.Physics] = {}
        self._kept: list[SceneLine] = []  # so that nothing else gets the places of their parameters

    def __call__(self, line: SceneLine) -> soft.Physics:
        scenes = [p.scene for p in line.points]
        key = (line.stencil, *(id(s.numbers) for s in scenes))
        if key not in self._made:
            physics = [s.body.physics(**s.parameters) for s in scenes]
            self._made[key] = difference_physics(physics, line.stencil.weights)
            self._kept.append(line)
        return self._made[key]


class _Observer:
    """Channels of a state, and their slopes along lines by differences (exact where linear)."""

    def __init__(self, scene: SoftScene, lines: Sequence[SceneLine]):
        self._observe, self._points = scene.observe, LinePoints(lines)
        self._each = [p.scene.observe for p in self._points.scenes]
        self._at_once = all(f == self._observe for f in self._each)
        self._checked = False

    def __call__(self, state: soft.State, tangent: soft.State) -> tuple[Tensor, Tensor]:
        x = self._points.at(state.x, tangent.x)
        if self._at_once and not self._checked:
            self._at_once, self._checked = self._try_leading_axes(x), True
        rows = self._observe(x) if self._at_once else self._differentiate_one_by_one(x)
        return self._observe(state.x), self._points.slopes(rows)

    def _differentiate_one_by_one(self, x: Tensor) -> Tensor:
        return torch.stack([f(one) for f, one in zip(self._each, x, strict=True)])

    def _try_leading_axes(self, x: Tensor) -> bool:
        expected = self._differentiate_one_by_one(x + torch.arange(len(x))[:, None, None])
        try:
            computed = self._observe(x + torch.arange(len(x))[:, None, None])
        except (IndexError, RuntimeError):
            return False  # it understands single states only
        return computed.shape == expected.shape and torch.allclose(computed, expected, rtol=1e-12)
