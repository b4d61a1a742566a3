"""A weight that hangs from a soft body by a limp string, and hangs slack for a while."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import torch
from torch import Tensor

from diffsim import soft
from diffsim.data.study import Run, Study
from diffsim.diagnose.beds.signals import sample
from diffsim.diagnose.beds.soft.scene import SoftScene
from diffsim.diagnose.effect import Effect


class SlackString(Effect):
    """The weight falls freely for the time size after release, then the string catches it.

    Until then the body moves without it; the catch is plastic (momentum is kept). Size 0 is the
    weight as a mass fixed to the body. Whether the size is physical can be checked: the tip must
    have come down by g size^2 / 2 by then.
    """

    name, family, kind, unit, typical = "slack_string", "load", "force", "s", 0.03
    signed = False
    also_looks_like = ("a hand that goes down with the tip at first", "weight let go later")

    def needs(self, study: Study) -> str | None:
        if not any(run.setup.get("tip_load_mass_kg", 0.0) > 0.0 for run in study.fit_runs):
            return "a run with a weight (setup tip_load_mass_kg)"
        return None

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        if not run.setup.get("tip_load_mass_kg", 0.0) > 0.0:
            return scene
        kept = {f.name: getattr(scene, f.name) for f in fields(scene)}
        return SlackScene(**kept, slack_s=size[0].clamp(min=0.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class SlackScene(SoftScene):
    """A scene whose ``attached_mass`` joins the body only after ``slack_s`` [s].

    Both phases have the scene's time step; the state at the catch lies between two steps, by cubics
    in the places and straight lines in the speeds. Hooks with memory go on from the step after it.
    """

    slack_s: Tensor = field(default_factory=lambda: torch.zeros((), dtype=torch.float64))

    def simulate(self) -> Tensor:
        """Predicted channels, (num_samples, num_channels)."""
        dt = self.body.dt
        load = self.parameter("attached_mass")
        times = self._times()
        loaded = self.body.physics(**self.parameters)
        free = self.body.physics(**{**self.parameters, "attached_mass": torch.zeros_like(load)})
        force = self._external_force()
        start = self.initial_state(None, loaded)

        before = int(float(self.slack_s.detach()) / dt)
        fall = soft.rollout(self.body, start, before + 1, external_force=force, physics=free)
        share = self.slack_s / dt - before
        caught = self._caught(_between(fall, before, share, dt), load)
        num_steps = max(5, int(float(times.detach().max()) / dt - before) + 3)
        swing = soft.rollout(
            self.body,
            caught,
            num_steps,
            external_force=None if force is None else lambda k, s: force(k + before, s),
            physics=loaded,
            keep=lambda state: self.observe(state.x),
        )
        free_fall = _padded(torch.stack([self.observe(x) for x in fall.x]))
        # channels are linear in the places: their rate is what they show of the speeds
        rate = self.observe(caught.x + caught.v) - self.observe(caught.x)
        early = sample(free_fall, dt, times)
        late = sample(swing.x, dt, times - self.slack_s, start_rate=rate)
        channels = torch.where((times < self.slack_s)[:, None], early, late)
        for change in self.output_maps:
            channels = change(channels, self.sample_times)
        return channels

    def _caught(self, state: soft.State, load: Tensor) -> soft.State:
        """After a plastic catch: along gravity, every loaded node shares the weight's momentum."""
        gravity = self.parameter("gravity")
        own = self.parameter("density") * self.body.nodal_volume
        down = gravity / gravity.norm()
        gap = (gravity * self.slack_s - state.v) @ down
        jump = (load / (load + own) * gap)[:, None] * down
        # a weight that never hung slack moves with the body already
        return soft.State(state.x, state.v + jump)


def _between(fall: soft.Trajectory, step: int, share: Tensor, dt: float) -> soft.State:
    """State a ``share`` of a step after ``step``."""
    x0, x1, v0, v1 = fall.x[step], fall.x[step + 1], fall.v[step], fall.v[step + 1]
    rise, s = x1 - x0, share
    x = x0 + s * (v0 * dt + s * (3 * rise - (2 * v0 + v1) * dt + s * ((v0 + v1) * dt - 2 * rise)))
    return soft.State(x, v0 + s * (v1 - v0))


def _padded(values: Tensor) -> Tensor:
    """At least six rows, as interpolation asks for; the last one again and again, never shown."""
    missing = max(0, 6 - len(values))
    return torch.cat([values, values[-1:].expand(missing, *values.shape[1:])])
