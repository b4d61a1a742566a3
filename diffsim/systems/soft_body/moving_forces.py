"""Extra forces of a soft scene and how they change along lines: differences of the hooks.

Every point of every line has a state of its own, x + offset X with X the line's tangent, and the
hooks of its own scene, which remember what they have seen there. Hooks that a line leaves as they
are see all such states at once.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from diffsim import soft
from diffsim.systems.soft_body.line import Key, LinePoints, OwnedScene, SceneLine, same_surroundings
from diffsim.systems.soft_body.scene import Force, Moment, SoftScene


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
        shared = {key: self._sharing(key, hook) for key, hook in hooks.items()}
        self._together = [
            (makers[k](), torch.tensor(list(p)), torch.stack(list(p.values()))[:, None, None])
            for k, p in shared.items()
            if p
        ]
        self._alone: list[tuple[int, SoftScene, list[Force]]] = []
        for p, owned in enumerate(self._points.scenes):
            own = [m() for k, m in owned.makers().items() if p not in shared.get(k, {})]
            self._alone.append((p, owned.scene, own))
        waters = [p.scene.water for p in self._points.scenes]
        self._waters = {
            water: torch.tensor([p for p, w in enumerate(waters) if w is water])
            for water in dict.fromkeys(w for w in waters if w is not None)
        }
        self._before: list[Tensor] = []
        self._before_rates: list[Tensor] = []

    def _sharing(self, key: Key, hook: Force) -> dict[int, Tensor]:
        """The points at which a hook of the scene is what it is there, or a multiple of that: its
        factor, by point."""
        if not hook.leading_axes:
            return {}
        shared, one = {}, torch.ones((), dtype=torch.float64)
        for p, (owned, effect) in enumerate(
            zip(self._points.scenes, self._points.effects, strict=True)
        ):
            if (effect is None or effect is not key[0]) and same_surroundings(
                self._scene, owned.scene, hook.reads
            ):
                shared[p] = one
            elif (make := owned.makers().get(key)) is not None:
                factor = hook.factor_of(make())
                if factor is not None:
                    shared[p] = factor
        return shared

    def total(self, k: int, state: soft.State) -> Tensor:
        """Nodal forces in step k, extrapolated as :class:`SoftScene` does [N]."""
        return self._ahead(self._before, self._scene.force_at(k, state, self._hooks))

    def rates(self, k: int, state: soft.State, tangent: soft.State) -> Tensor:
        """Their derivatives (K, V, 3)."""
        dt = self._scene.body.dt
        x = self._points.at(state.x, tangent.x)
        v = self._points.at(state.v, tangent.v)
        total = torch.zeros_like(x)
        for water, idx in self._waters.items():
            flow = torch.stack([self._points.scenes[int(p)].scene.current for p in idx])
            total.index_add_(0, idx, water(x[idx], v[idx], water_velocity=flow))
        for hook, idx, factor in self._together:
            force = hook(self._scene, Moment(x[idx], v[idx], k * dt, dt))
            total.index_add_(0, idx, factor * force)
        for p, scene, hooks in self._alone:
            for hook in hooks:
                total[p] += hook(scene, Moment(x[p], v[p], k * dt, dt))
        return self._ahead(self._before_rates, self._points.slopes(total))

    def _ahead(self, before: list[Tensor], now: Tensor) -> Tensor:
        past = before.pop() if before else now
        before.append(now)
        return now + self._scene.ahead * (now - past)
