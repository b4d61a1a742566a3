"""Scenes along one coordinate: what a difference formula sees of it.

Scenes that differ by their commands alone are simulated in one rollout: a scan over sizes of a dead
band or a backlash asks for many. A step of a batch costs little more than one of a single body as
long as bodies are small.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from diffsim import soft
from diffsim.identify.effect import Effect
from diffsim.identify.jacobian import Stencil
from diffsim.systems.soft_body.scene import Force, SoftScene

Key = tuple[Effect | None, int]


@dataclass(frozen=True, eq=False)
class OwnedScene:
    """A scene, and of each of its extra forces the effect that added it."""

    scene: SoftScene  # scene of one run, with the effects built in
    # one per entry of ``scene.makers``; None: it was there before all effects
    owners: tuple[Effect | None, ...]

    def makers(self) -> dict[Key, Callable[[], Force]]:
        """Functions that make the forces, by owner and place among the owner's."""
        count: Counter[Effect | None] = Counter()
        out = {}
        for owner, make in zip(self.owners, self.scene.makers, strict=True):
            out[owner, count[owner]] = make
            count[owner] += 1
        return out


@dataclass(frozen=True, eq=False)
class SceneLine:
    """One line: the scenes at the points of its stencil."""

    stencil: Stencil  # difference formula for what is cheap to evaluate at its points
    points: tuple[OwnedScene, ...]  # scenes at the stencil's offsets
    effect: Effect | None  # effect whose size moves along the line; None: a base parameter does

    def mapped(self, f: Callable[[float, Any], SoftScene]) -> SceneLine:
        """The line of the scenes f(offset, scene) at its points."""
        points = zip(self.stencil.offsets, self.points, strict=True)
        made = tuple(OwnedScene(f(o, p.scene), p.owners) for o, p in points)
        return SceneLine(self.stencil, made, self.effect)

    def difference(self, f: Callable[[float, Any], Tensor]) -> Tensor:
        """The slope of f(offset, scene)."""
        terms = zip(self.stencil.offsets, self.stencil.weights, self.points, strict=True)
        return torch.stack([w * f(o, p.scene) for o, w, p in terms]).sum(0)


class LinePoints:
    """The points of several lines in a row.

    Args:
        lines: K lines with P points together.
    """

    def __init__(self, lines: Sequence[SceneLine]):
        self.scenes = [p for n in lines for p in n.points]
        self.effects = [n.effect for n in lines for _ in n.points]
        # int64 where there are no lines, too: nothing may move
        rows = [k for k, n in enumerate(lines) for _ in n.points]
        self._line_of = torch.tensor(rows, dtype=torch.int64)
        self._offset = _make_row([o for n in lines for o in n.stencil.offsets])[:, None, None]
        self._weight = torch.zeros(len(lines), len(self.scenes), dtype=torch.float64)
        weights = _make_row([w for n in lines for w in n.stencil.weights])
        self._weight[self._line_of, torch.arange(len(weights))] = weights

    def at(self, x: Tensor, tangent: Tensor) -> Tensor:
        """States (P, V, 3) around a state (V, 3) along its tangents (K, V, 3)."""
        return x + self._offset * tangent[self._line_of]

    def slopes(self, rows: Tensor) -> Tensor:
        """(K, ...) from values at the points, (P, ...)."""
        return torch.tensordot(self._weight, rows, 1)


def same_surroundings(a: SoftScene, b: SoftScene, reads: tuple[str, ...] | None) -> bool:
    """Whether two scenes are equal in all that forces read from them.

    Args:
        a, b: Scenes of one body.
        reads: Names of the physical parameters that the forces read; None: all.
    """
    values = [
        (a.current, b.current),
        (a.friction_shares, b.friction_shares),
        (a.hung_mass, b.hung_mass),
    ]
    if reads is None:  # forces that say what they read do not read how it starts
        values += [
            (a.start_position, b.start_position),
            (a.start_velocity, b.start_velocity),
        ]
    names = {*a.parameters, *b.parameters} if reads is None else reads
    values += [(a.number(n), b.number(n)) for n in names]
    same = all(x is y or (x is not None and y is not None and torch.equal(x, y)) for x, y in values)
    same = same and a.fluid_density == b.fluid_density and a.start_time == b.start_time
    return same and a.water is b.water


def _make_row(values: Sequence[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def simulate_together(scenes: Sequence[Any]) -> list[Tensor]:
    """Predictions of scenes, (num_samples, num_channels) each; those alike in one rollout.

    Args:
        scenes: Scenes of one run, of any kind.
    """
    out: dict[int, Tensor] = {}
    waiting = list(range(len(scenes)))
    while waiting:
        first = scenes[waiting[0]]
        group = [k for k in waiting if k == waiting[0] or _are_alike(first, scenes[k])]
        if len(group) == 1:
            out[group[0]] = first.simulate()
        else:
            out |= zip(group, _simulate_group([scenes[k] for k in group]), strict=True)
        waiting = [k for k in waiting if k not in out]
    return [out[k] for k in range(len(scenes))]


def _are_alike(a: Any, b: Any) -> bool:
    """Whether two scenes differ by their commands and by what is read off them alone."""
    if type(a) is not SoftScene or type(b) is not SoftScene or a.body is not b.body:
        return False
    if any(s.makers or s.water or s.obstacles or s.pressurize is not None for s in (a, b)):
        return False
    if not (a.is_commanded and b.is_commanded) or not a.body.muscles.num_muscles:
        return False
    settings = [(s.start, s.num_steps(), tuple(s.relaxed)) for s in (a, b)]
    return settings[0] == settings[1] and not a.relaxed and same_surroundings(a, b, None)


def _simulate_group(scenes: Sequence[SoftScene]) -> list[Tensor]:
    scene = scenes[0]
    num_steps, physics = scene.num_steps(), scene.body.physics(**scene.parameters)
    every = [s.activations(num_steps) for s in scenes]
    activations = torch.stack([a for a in every if a is not None], dim=1)
    starts = [s.initial_state(a, physics) for s, a in zip(scenes, activations[0], strict=True)]
    state = soft.State(torch.stack([s.x for s in starts]), torch.stack([s.v for s in starts]))

    def observe(now: soft.State) -> Tensor:
        return torch.stack([s.observe(x) for s, x in zip(scenes, now.x, strict=True)])

    observed = soft.rollout(
        scene.body,
        state,
        num_steps,
        activation=lambda k, now: activations[k],
        physics=physics,
        keep=observe,
    ).x
    return [s.channels(observed[:, k]) for k, s in enumerate(scenes)]
