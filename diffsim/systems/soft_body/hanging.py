"""A weight that hangs from a soft body by a limp string, and hangs slack for a while."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.interpolation import sample
from diffsim.causes.scene import Instruments, grid_at
from diffsim.data.study import Run
from diffsim.systems.soft_body.line import OwnedScene, SceneLine
from diffsim.systems.soft_body.scene import SoftScene
from diffsim.systems.soft_body.tangents import motion_tangents


def hang_slack(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """The weight falls freely by the height size after release, then the string catches it.

    Until then the body moves without it; the catch is plastic (momentum is kept). Size 0 is the
    weight as a mass fixed to the body. Whether the size is physical can be checked: the tip must
    have come down as far by then.

    Not smooth: the time of the fall, sqrt(2 size / g), has no derivative at 0.
    """
    carries = bool((scene.number("attached_mass") > 0.0).any())
    if not carries or not float(size[0].detach()) > 0.0:
        return scene
    kept = {f.name: getattr(scene, f.name) for f in fields(scene)}
    g = scene.number("gravity").norm()
    return SlackScene(**kept, slack_s=(2.0 * size[0] / g).sqrt())


@dataclass(frozen=True, kw_only=True, eq=False)
class SlackScene(SoftScene):
    """A scene whose ``attached_mass`` joins the body only after ``slack_s`` [s].

    Two motions, one after the other: the body alone, then with the weight from the state at the
    catch, which lies between steps and is computed by cubics in the places. Hooks with memory start
    anew at the catch.
    """

    slack_s: Tensor = field(default_factory=lambda: torch.zeros((), dtype=torch.float64))

    def simulate(self) -> Tensor:
        """Predicted channels, (num_samples, num_channels)."""
        last = self.last_fall_step()
        falling = self.falling(last)
        fall = falling.motion(falling.num_steps())
        swinging = self.swinging(fall, last)
        return self.joined(fall, swinging.motion(swinging.num_steps()), last)

    def last_fall_step(self) -> int:
        """Index of the step before the catch."""
        return int(float(self.slack_s.detach()) / self.body.dt)

    def falling(self, last: int) -> SoftScene:
        """The body without the weight; places of all nodes are observed."""
        load = self.number("attached_mass")
        return self._make_plain(
            grid=grid_at(torch.tensor([(last + 1.0) * self.body.dt], dtype=torch.float64)),
            clock_offset=torch.zeros((), dtype=torch.float64),
            instruments=Instruments(),
            numbers={**self.parameters, "attached_mass": torch.zeros_like(load)},
            observe=_flatten_places,
        )

    def swinging(self, fall: Tensor, last: int) -> SoftScene:
        """From the catch on: plastic along gravity, every loaded node shares the momentum."""
        x, v = self._interpolate_catch(fall, last)
        load, gravity = self.number("attached_mass"), self.number("gravity")
        down = gravity / gravity.norm()
        own = self.solid_mass
        gap = (gravity * self.slack_s - v) @ down
        return self._make_plain(
            start="given",
            start_position=x,
            start_velocity=v + (load / (load + own) * gap)[:, None] * down,
            start_time=float(self.slack_s.detach()),
        )

    def joined(self, fall: Tensor, swing: Tensor, last: int) -> Tensor:
        """Channels of both motions, each at its times."""
        dt = self.body.dt
        caught = self.swinging(fall, last)
        x, v = caught.initial_state(None, self.body.physics(**caught.parameters))[:2]
        # channels are linear in the places: their rate is what they show of the speeds
        rate = self.observe(x + v) - self.observe(x)
        falls = torch.stack([self.observe(p.reshape(-1, 3)) for p in fall])

        def observed_at(times: Tensor) -> Tensor:
            early = sample(falls, dt, times)
            late = sample(swing, dt, times - self.slack_s, start_rate=rate)
            return torch.where((times < self.slack_s)[:, None], early, late)

        return self.by_clock(observed_at)

    def _make_plain(self, **changes: Any) -> SoftScene:
        kept = {f.name: getattr(self, f.name) for f in fields(SoftScene)}
        return SoftScene(**(kept | changes))

    def _interpolate_catch(self, fall: Tensor, last: int) -> tuple[Tensor, Tensor]:
        """Places and speeds (num_nodes, 3) by Lagrange through four steps around the catch."""
        first = max(last - 1, 0)
        s = self.slack_s / self.body.dt - first
        nodes = range(4)
        value, slope = [], []
        for i in nodes:
            others = [j for j in nodes if j != i]
            scale = float(np.prod([i - j for j in others]))
            value.append(torch.stack([s - j for j in others]).prod() / scale)
            pairs = [(a, b) for k, a in enumerate(others) for b in others[k + 1 :]]
            slope.append(torch.stack([(s - a) * (s - b) for a, b in pairs]).sum() / scale)
        around = fall[first : first + 4]
        x = torch.tensordot(torch.stack(value), around, 1).reshape(-1, 3)
        v = torch.tensordot(torch.stack(slope), around, 1).reshape(-1, 3) / self.body.dt
        return x, v


def slack_tangents(base: OwnedScene, lines: Sequence[SceneLine]) -> tuple[Tensor, Tensor]:
    """Tangents as of :func:`scene_tangents`; tangents of the fall move the start of the swing."""
    scene = base.scene
    assert isinstance(scene, SlackScene)
    last = scene.last_fall_step()
    falls = [line.mapped(lambda o, s: s.falling(last)) for line in lines]
    fall, fall_rates = motion_tangents(OwnedScene(scene.falling(last), base.owners), falls)

    def later(rate: Tensor, offset: float, moved: SlackScene) -> SoftScene:
        return moved.swinging(fall + offset * rate, last)

    swings = [
        line.mapped(partial(later, rate)) for line, rate in zip(lines, fall_rates, strict=True)
    ]
    start = OwnedScene(scene.swinging(fall, last), base.owners)
    swing, swing_rates = motion_tangents(start, swings)

    def shown(early: Tensor, late: Tensor, offset: float, moved: SlackScene) -> Tensor:
        return moved.joined(fall + offset * early, swing + offset * late, last)

    columns = [
        line.difference(partial(shown, early, late))
        for line, early, late in zip(lines, fall_rates, swing_rates, strict=True)
    ]
    here = scene.joined(fall, swing, last)
    return here, torch.stack(columns) if columns else here.new_zeros(0, *here.shape)


def _flatten_places(x: Tensor) -> Tensor:
    """All nodes' places in a row, (..., 3 num_nodes)."""
    return x.flatten(-2)
