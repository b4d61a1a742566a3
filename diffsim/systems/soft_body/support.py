"""The support of a soft body moves, as markers on it show."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.interpolate import make_interp_spline
from torch import Tensor

from diffsim.data.study import Run
from diffsim.systems.soft_body.kept import OfScene, OfTime
from diffsim.systems.soft_body.scene import Force, Moment, SoftScene


def move_support(
    scene: SoftScene,
    size: Tensor,
    run: Run,
    *,
    names: tuple[str, str],
    faster_hz: float | None = None,
) -> SoftScene:
    """Move the support: shift times what its markers show, and turn.

    ``shift``: 1 if the markers show it all. ``turn``: rotation about y per forward displacement,
    times the body's length; a stand that sways about an axis far below has little, one that tips
    near the clamp much. The body is simulated in the support's frame, with its inertia as a force,
    and seen from the room. Left out is that gravity turns with that frame: it acts along the bar.

    The record of the support is an input, as a command is: on runs held out, too. ``names`` are
    commands with its places along the body and up [m]; what is faster than ``faster_hz`` is noise.
    """
    path = _Path(_smooth_places(run, names, faster_hz), run, scene, size)
    if not path.moves:
        return scene
    rest = scene.body.x_rest
    # what is observed is linear in the places
    shown = torch.stack([scene.observe(rest + m) for m in path.modes]) - scene.observe(rest)

    def seen(y: Tensor, times: Tensor) -> Tensor:
        return y + path.amplitudes(times.detach().numpy(), 0) @ shown

    return scene.with_hook(lambda: _Inertia(path)).with_places(seen)


def _smooth_places(run: Run, names: tuple[str, str], faster_hz: float | None) -> np.ndarray:
    """(num_samples, 2) forward and up, without what is faster than ``faster_hz``: no delay.

    The support's acceleration is what acts; differences of a noisy record would be all noise.
    """
    from scipy.signal import butter, filtfilt

    places = np.column_stack([run.command[name] for name in names])
    rate_hz = 1.0 / float(np.median(np.diff(run.time_s)))
    if faster_hz is None or 2.0 * faster_hz >= rate_hz:
        return places
    return np.asarray(filtfilt(*butter(4, faster_hz, fs=rate_hz), places, axis=0))


class _Path:
    """Rigid motion of a support, small: shift of its middle forward and up, rotation about y.

    Args:
        places: (num_samples, 2) recorded places of the support, forward and up [m].
        run: Run with the times of the record.
        scene: Scene whose fixed nodes are the support.
        size: Shift [m] and turn [rad] of the support, (2,).

    Attributes:
        moves: Whether the record shows any motion.
        modes: (3, num_nodes, 3) displacement of all nodes per forward shift, upward shift [-]
            and rotation [m].
    """

    def __init__(self, places: np.ndarray, run: Run, scene: SoftScene, size: Tensor):
        self.moves = bool((places != places[0]).any())
        # on the clock of the scene
        time = np.asarray(run.time_s) - run.time_s[0] + float(scene.sample_times[0])
        self._spline: Any = make_interp_spline(time, places, k=5)
        rest = scene.body.x_rest
        length = float((rest.amax(0) - rest.amin(0)).max())
        self._ends, self._size, self._turn = (time[0], time[-1]), size, size[1] / length
        arm = rest - rest[scene.body.fixed.all(-1)].mean(0)
        one, none = torch.ones_like(arm[:, 0]), torch.zeros_like(arm[:, 0])
        fields = [(one, none, none), (none, none, one), (arm[:, 2], none, -arm[:, 0])]
        self.modes = torch.stack([torch.stack(f, -1) for f in fields])

    def amplitudes(self, times: np.ndarray, order: int) -> Tensor:
        """(num_times, 3) of the modes, or a derivative in time; the support rests in the end."""
        first, last = self._ends
        at = self._spline(np.clip(times, first, last), order)
        if order:
            at = at * ((times >= first) & (times <= last))[:, None]
        x, z = torch.from_numpy(at).unbind(-1)
        return torch.stack([self._size[0] * x, self._size[0] * z, self._turn * x], -1)


class _Inertia(Force):
    """Minus mass times the frame's acceleration."""

    leading_axes, reads = True, ("density", "attached_mass", "added_mass")

    def __init__(self, path: _Path):
        self._modes = path.modes.flatten(1)
        self._rates = OfTime(lambda times: path.amplitudes(times.numpy(), 2))
        self._mass = OfScene(lambda scene: -scene.inert_mass[:, None])

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        frame = (self._rates(moment)[None] @ self._modes).view(-1, 3)
        return (self._mass(scene) * frame).expand(moment.x.shape)
