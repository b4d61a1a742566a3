"""Extra forces of a soft scene and how they change along lines: differences of the hooks.

Every point of every line has a state of its own, x + offset X with X the line's tangent, and the
hooks of its own scene, which remember what they have seen there. Hooks that a line leaves as they
are see all such states at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim import soft
from diffsim.identify.problem import PredictionError
from diffsim.systems.soft_body.line import Key, LinePoints, OwnedScene, SceneLine, same_surroundings
from diffsim.systems.soft_body.scene import Force, Moment, SoftScene

_ONE = torch.ones((), dtype=torch.float64)


class _Together(NamedTuple):
    """A hook that is evaluated once for several points."""

    scene: SoftScene
    hook: Force  # the hook, of the same form at all of them
    idx: Tensor  # (n,) the points
    factor: Tensor  # (n, 1, 1) how many times as large the force is at each

    @classmethod
    def of(cls, scene: SoftScene, hook: Force, points: Mapping[int, Tensor]) -> _Together:
        """Of factors by point."""
        factor = torch.stack(list(points.values()))[:, None, None]
        return cls(scene, hook, torch.tensor(list(points)), factor)


def _at_once(hooks: Sequence[tuple[int, SoftScene, Force]]) -> _Together | None:
    """Hooks of one maker at points as one hook, which knows them all; None: they are no such."""
    (_, scene, hook), *others = hooks
    alike = all(same_surroundings(scene, s, hook.reads) for _, s, _ in others)
    if not others or not hook.leading_axes or not alike:
        return None
    one = hook.stacked_with([h for _, _, h in others])
    return None if one is None else _Together.of(scene, one, {p: _ONE for p, _, _ in hooks})


def _group_multiples(
    hooks: Sequence[tuple[int, SoftScene, Force]],
) -> list[tuple[SoftScene, Force, dict[int, Tensor]]]:
    """Hooks of one maker at points, in groups: the first of each, and factors by point."""
    groups: list[tuple[SoftScene, Force, dict[int, Tensor]]] = []
    for p, scene, hook in hooks:
        for first, same, points in groups:
            factor = _find_factor(first, same, scene, hook)
            if factor is not None:
                points[p] = factor
                break
        else:
            groups.append((scene, hook, {p: _ONE}))
    return groups


def _find_factor(one: SoftScene, hook: Force, two: SoftScene, other: Force) -> Tensor | None:
    """How many times as large another hook is in its scene; None: it has to be evaluated."""
    if not hook.leading_axes or not same_surroundings(one, two, ()):
        return None
    return hook.factor_of(other)


class MovingForces:
    """Forces of one rollout and their tangents; both remember, so this serves one rollout.

    Args:
        base: Scene that the lines start from.
        lines: K lines to differentiate along.
    """

    def __init__(self, base: OwnedScene, lines: Sequence[SceneLine]):
        self._scene, self._points = base.scene, LinePoints(lines)
        makers = base.makers()
        hooks = {key: make() for key, make in makers.items()}
        self._hooks = list(hooks.values())
        shared = {key: self._find_sharing(key, hook) for key, hook in hooks.items()}
        self._together = [_Together.of(self._scene, makers[k](), p) for k, p in shared.items() if p]
        left: dict[Key, list[tuple[int, SoftScene, Force]]] = {}
        for p, owned in enumerate(self._points.scenes):
            for key, make in owned.makers().items():
                if p not in shared.get(key, {}):
                    left.setdefault(key, []).append((p, owned.scene, make()))
        self._alone: list[tuple[int, SoftScene, Force]] = []
        for hooks_left in left.values():
            if (at_once := _at_once(hooks_left)) is not None:
                self._together.append(at_once)
                continue
            for scene, hook, points in _group_multiples(hooks_left):
                if len(points) > 1:
                    self._together.append(_Together.of(scene, hook, points))
                else:
                    self._alone += [(p, scene, hook) for p in points]
        waters = [p.scene.water for p in self._points.scenes]
        self._waters = {
            water: torch.tensor([p for p, w in enumerate(waters) if w is water])
            for water in dict.fromkeys(w for w in waters if w is not None)
        }
        self._before: list[Tensor] = []
        self._before_rates: list[Tensor] = []

    def _find_sharing(self, key: Key, hook: Force) -> dict[int, Tensor]:
        """The points at which a hook of the scene is what it is there, or a multiple of that: its
        factor, by point."""
        if not hook.leading_axes:
            return {}
        shared = {}
        for p, (owned, effect) in enumerate(
            zip(self._points.scenes, self._points.effects, strict=True)
        ):
            if (effect is None or effect is not key[0]) and same_surroundings(
                self._scene, owned.scene, hook.reads
            ):
                shared[p] = _ONE
            elif (make := owned.makers().get(key)) is not None:
                factor = _find_factor(self._scene, hook, owned.scene, make())
                if factor is not None:
                    shared[p] = factor
        return shared

    def total(self, k: int, state: soft.State) -> Tensor:
        """Nodal forces in step k, extrapolated as :class:`SoftScene` does [N]."""
        return self._extrapolate(self._before, self._scene.force_at(k, state, self._hooks))

    def rates(self, k: int, state: soft.State, tangent: soft.State) -> Tensor:
        """Their derivatives (K, V, 3)."""
        dt = self._scene.body.dt
        x = self._points.at(state.x, tangent.x)
        v = self._points.at(state.v, tangent.v)
        total = torch.zeros_like(x)
        for water, idx in self._waters.items():
            flow = torch.stack([self._points.scenes[int(p)].scene.current for p in idx])
            total.index_add_(0, idx, water(x[idx], v[idx], water_velocity=flow))
        for scene, hook, idx, factor in self._together:
            force = hook(scene, Moment(x[idx], v[idx], scene.time_of(k), dt))
            total.index_add_(0, idx, factor * force)
        for p, scene, hook in self._alone:
            total[p].add_(hook(scene, Moment(x[p], v[p], scene.time_of(k), dt)))
        rates = self._extrapolate(self._before_rates, self._points.slopes(total))
        if not bool(torch.isfinite(rates).all()):  # a motion that runs away: too far for a fit
            time = round(self._scene.time_of(k), 4)
            raise PredictionError(f"derivatives of forces left the range of numbers at {time} s")
        return rates

    def _extrapolate(self, before: list[Tensor], now: Tensor) -> Tensor:
        past = before.pop() if before else now
        before.append(now)
        return now + self._scene.ahead * (now - past)
