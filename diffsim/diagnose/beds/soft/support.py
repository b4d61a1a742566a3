"""The support of a soft body moves, as markers on it show."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.interpolate import make_interp_spline
from torch import Tensor

from diffsim.diagnose.beds.soft.scene import Force, Moment, SoftScene
from diffsim.diagnose.effect import Effect

if TYPE_CHECKING:
    from diffsim.data.study import Run, Study

COMMANDS = ("support_x_m", "support_z_m")  # recorded places of the support: along the bar, up


class SupportMotion(Effect):
    """What holds the body moves: shift times what its markers show, and turns as it goes.

    ``shift``: 1 if the markers show it all. ``turn``: rotation about y per forward displacement,
    times the body's length; a stand that sways about an axis far below has little, one that tips
    near the clamp much. The body is simulated in the support's frame, with its inertia as a force,
    and seen from the room. Left out is that gravity turns with that frame: it acts along the bar.

    The record of the support is an input, as a command is: on runs held out, too.
    """

    name, family, kind, unit, typical = "support_motion", "support", "environment", "-", 1.0
    components = ("shift", "turn")
    also_looks_like = (
        "a stand that resonates with the body",
        "floor vibration",
        "cameras that sway",
    )

    def needs(self, study: Study) -> str | None:
        if not all(set(COMMANDS) <= set(run.command) for run in study.runs):
            return f"the support's recorded motion in every run (commands {', '.join(COMMANDS)})"
        return None

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        path = _Path(run, scene, size)
        if not path.moves:
            return scene
        still = scene.body.x_rest

        def seen(y: Tensor, times: Tensor) -> Tensor:
            moved = still + path.field(times.detach().numpy(), 0)
            return y + torch.stack([scene.observe(x) for x in moved]) - scene.observe(still)

        return scene.with_force(lambda: _Inertia(path)).with_output(seen)


class _Path:
    """Rigid motion of a support, small: shift of its middle, rotation about y.

    Args:
        run: With the support's record.
        scene: Whose fixed nodes are the support.
        size: (2,) shift, turn.
    """

    def __init__(self, run: Run, scene: SoftScene, size: Tensor):
        places = np.column_stack([run.command[name] for name in COMMANDS])
        self.moves = bool((places != places[0]).any())
        time = np.asarray(run.time_s) - run.time_s[0]
        self._spline: Any = make_interp_spline(time, places, k=5)
        self._last, self._size = float(time[-1]), size
        rest = scene.body.x_rest
        self._length = float((rest.amax(0) - rest.amin(0)).max())
        arm = rest - rest[scene.body.fixed.all(-1)].mean(0)
        # displacement of every node per rotation about y
        self._turn = torch.stack([arm[:, 2], torch.zeros_like(arm[:, 0]), -arm[:, 0]], -1)

    def field(self, times: np.ndarray, order: int) -> Tensor:
        """(num_times, num_vertices, 3) displacement of the frame at its nodes, or a derivative."""
        at = self._spline(np.clip(times, 0.0, self._last), order)
        if order:  # a support whose record has ended rests
            at = at * ((times >= 0.0) & (times <= self._last))[:, None]
        x, z = torch.from_numpy(at).unbind(-1)
        shift = torch.stack([x, torch.zeros_like(x), z], -1)[:, None, :]
        return self._size[0] * shift + self._size[1] / self._length * x[:, None, None] * self._turn


class _Inertia(Force):
    """Minus mass times the frame's acceleration."""

    leading_axes, reads = True, ("density", "attached_mass", "added_mass")

    def __init__(self, path: _Path):
        self._path = path

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        mass = scene.parameter("density") * scene.body.nodal_volume
        mass = mass + scene.parameter("attached_mass") + scene.parameter("added_mass")
        acceleration = self._path.field(np.array([moment.time]), 2)[0]
        return (-mass[:, None] * acceleration).expand(moment.x.shape)
