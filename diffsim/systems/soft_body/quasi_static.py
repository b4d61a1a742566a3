"""A soft body that follows its commands through equilibria: poses, and slow motions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.causes.interpolation import curved, straight
from diffsim.core.memo import Memo
from diffsim.systems.soft_body.loads import HungWeight
from diffsim.systems.soft_body.scene import SoftScene

Key = tuple[float, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedScene(SoftScene):
    """A scene that is in equilibrium under its command at every sample.

    With one command, poses are computed at evenly spaced values of it, each from the one before,
    and others by cubics between them; else every pose by itself.
    """

    # (num_poses,) values of the only command at which poses are computed; None: at every sample
    pose_commands: Tensor | None = None
    kept: Memo[Tensor]  # poses that were computed before, by what they depend on

    def simulate(self) -> Tensor:
        """Predicted channels, (num_samples, num_channels)."""
        return self.by_clock(self._observe_at)

    def _observe_at(self, times: Tensor) -> Tensor:
        """What is observed in equilibrium at times (num_samples,) [s], (num_samples, width)."""
        if not self.is_commanded:
            still = self._observe_poses(torch.zeros(1, 0, dtype=torch.float64))
            return still.expand(len(times), -1)
        wanted = straight(self.command_heard(), self.command_dt, times)
        if self.pose_commands is None:
            return self._observe_poses(wanted)
        knots = self.pose_commands
        places = self._observe_poses(knots[:, None])
        spacing = float(knots[1] - knots[0])
        return curved(places, spacing, wanted[:, 0] - float(knots[0]))

    def _observe_poses(self, commands: Tensor) -> Tensor:
        """What is observed in equilibrium under each row of commands, (num_rows, width)."""
        drives = self.actuate(commands) if self.actuate is not None else commands
        pressures = None if self.pressurize is None else self.pressurize(commands)
        key = self._make_key([drives, *([] if pressures is None else [pressures])])
        if key is None:
            return self._solve_poses(commands, drives, pressures)
        return self.kept(key, lambda: self._solve_poses(commands, drives, pressures))

    def _solve_poses(self, commands: Tensor, drives: Tensor, pressures: Tensor | None) -> Tensor:
        physics = self.body.physics(**self.parameters)
        order = commands.detach().norm(dim=-1).argsort().tolist()
        found: dict[int, Tensor] = {}
        guess = None
        for k in order:
            activation = drives[k] if self.body.muscles.num_muscles else None
            pressure = None if pressures is None else pressures[k]
            state = self.equilibrium(activation, physics, pressure=pressure, guess=guess)
            guess, found[k] = state.x.detach(), self.observe(state.x)
        return torch.stack([found[k] for k in range(len(order))])

    def _make_key(self, drives: list[Tensor]) -> Key | None:
        """All that poses depend on; None where it is not known, or gradients are wanted."""
        if any(make is not HungWeight for make in self.makers) or self.water is not None:
            return None
        given = [*self.parameters.values(), *drives]
        given += [] if self.hung_mass is None else [self.hung_mass]
        if torch.is_grad_enabled() and any(v.requires_grad for v in given):
            return None
        return tuple(v for one in given for v in one.detach().flatten().tolist())


def pose_commands(fitted: Sequence[float], now: Sequence[float], num_poses: int) -> Tensor | None:
    """Values of a command at which poses are computed, evenly spaced.

    A model that was fitted keeps its poses on runs that go further, and gets more of them beyond,
    at the same spacing: a frozen model must neither lose resolution nor refuse a larger stroke.

    Args:
        fitted: Least and greatest value among the runs that were fitted.
        now: Least and greatest value that is wanted.
        num_poses: Poses within what was fitted.

    Returns:
        (num_poses + added,) values; None where the command is always the same.
    """
    if not fitted[1] > fitted[0]:
        return None
    first, last = _add_margin(fitted)
    knots = torch.linspace(first, last, num_poses, dtype=torch.float64)
    spacing = float(knots[1] - knots[0])
    low, high = _add_margin((min(now[0], fitted[0]), max(now[1], fitted[1])))
    # rounding adds no pose
    counts = [math.ceil(far / spacing - 1e-9) for far in (first - low, high - last)]
    below, above = (
        # times as many as were stated, on each side; straight lines beyond
        torch.arange(1, min(max(n, 0), 10 * num_poses) + 1, dtype=torch.float64)
        for n in counts
    )
    return torch.cat([knots[0] - spacing * below.flip(0), knots, knots[-1] + spacing * above])


def _add_margin(reach: Sequence[float]) -> tuple[float, float]:
    """Ends a little beyond, as effects push commands there; what only pulls ends at zero."""
    margin = 0.1 * (reach[1] - reach[0])  # for causes that enlarge the command
    return (reach[0] - margin if reach[0] < 0.0 else 0.0), reach[1] + margin


def posed(scene: SoftScene, commands: Tensor | None, kept: Memo[Tensor]) -> PosedScene:
    """The scene as a sequence of equilibria.

    Args:
        commands: Values of the only command at which poses are computed; None: at every sample.
        kept: Where poses are kept, shared by all scenes of a body.
    """
    own = {name: getattr(scene, name) for name in SoftScene.__dataclass_fields__}
    return PosedScene(**own, pose_commands=commands, kept=kept)
