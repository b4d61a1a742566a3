"""What a rig does under the commands of several models, side by side, as a moving picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.pays.trial import Trial

Array = NDArray[np.float64]
Lines = list[Array]  # each (num_points, 2) [m, or degrees]
SHOWN = {"plain": "C3", "randomized": "C4", "residual": "C1", "extended": "C0"}
PAUSE = 15  # frames that the end stands still


def _along(angle: float, length: float) -> Array:
    """From a joint along a link that hangs at an angle, (2,) [m]."""
    return length * np.array([np.sin(angle), -np.cos(angle)])


def _bar(center: Array, half: float, angle: float = 0.0) -> Array:
    """A bar whose end ahead sinks by an angle, (2, 2) [m]."""
    way = half * np.array([np.cos(angle), -np.sin(angle)])
    return np.array([center - way, center + way])


def _arm(seen: Mapping[str, float]) -> Lines:
    elbow = _along(seen["q1"], 0.3)
    return [np.array([np.zeros(2), elbow, elbow + _along(seen["q1"] + seen["q2"], 0.24)])]


def _crane(seen: Mapping[str, float]) -> Lines:
    trolley = np.array([seen["trolley"], 0.0])
    return [_bar(trolley, 0.06), np.array([trolley, trolley + _along(seen["rod"], 0.5)])]


def _finger(seen: Mapping[str, float]) -> Lines:
    return [np.array([np.zeros(2), _along(seen["bend"], 0.1)])]


def _spindle(seen: Mapping[str, float]) -> Lines:
    return [_bar(np.array([seen["place"], 0.0]), 0.004)]


def _gimbal(seen: Mapping[str, float]) -> Lines:
    look = np.degrees([seen["pan"], seen["tilt"]])
    return [look + np.array([[-6.0, 0], [6, 0]]), look + np.array([[0.0, -6], [0, 6]])]


def _quadrotor(seen: Mapping[str, float]) -> Lines:
    center = np.array([seen["ahead"], seen["height"]])
    return [_bar(center, 0.17, seen["pitch"])]


SHAPES: Mapping[str, Callable[[Mapping[str, float]], Lines]] = {
    "arm": _arm,
    "spindle": _spindle,
    "gimbal": _gimbal,
    "crane": _crane,
    "finger": _finger,
    "quadrotor": _quadrotor,
}


def film(row: Mapping[str, Any], out: Path) -> Path:
    """Write what the rig of one seed does under four commands; gray is what was wanted.

    Args:
        row: Of the table, with knots of every method.
        out: Folder of the folders.

    Returns:
        An animated WebP, in real time.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.animation import FuncAnimation, PillowWriter

    trial = Trial.made(row["rig"], row["seed"], out)
    shape, channels = SHAPES[row["rig"]], [c.name for c in trial.study.channels]
    paths = {m: trial.execute(np.array(row["knots"][m])) for m in SHOWN}
    wanted = trial.task.courses.numpy()
    step = trial.task.given.every
    figure, axes = plt.subplots(1, len(SHOWN), figsize=(2.2 * len(SHOWN), 2.6), squeeze=False)
    box = _box(shape, channels, [wanted, *paths.values()])
    moving = []
    for axis, (method, color) in zip(axes[0], SHOWN.items(), strict=True):
        axis.set(xlim=box[0], ylim=box[1], aspect="equal", xticks=[], yticks=[])
        axis.set_title(f"{method}: {row['scores'][method]:.3g}", fontsize=10)
        for path, style in (
            (wanted, {"color": "0.75", "lw": 7}),
            (paths[method], {"color": color}),
        ):
            drawn = [
                axis.plot([], [], **{"lw": 3, **style})[0] for _ in shape(_seen(channels, path[0]))
            ]
            moving.append((path, drawn))
    figure.tight_layout()

    def show(frame: int) -> list[Any]:
        for path, drawn in moving:
            lines = shape(_seen(channels, path[min(frame, len(path) - 1)]))
            for artist, line in zip(drawn, lines, strict=True):
                artist.set_data(line[:, 0], line[:, 1])
        return [artist for _, drawn in moving for artist in drawn]

    made = FuncAnimation(figure, show, frames=range(0, len(wanted) + 2 * PAUSE, 2))
    target = out / f"{row['rig']}.webp"
    made.save(target, writer=PillowWriter(fps=round(0.5 / step)), dpi=80)
    plt.close(figure)
    return target


def _seen(channels: Sequence[str], values: Array) -> dict[str, float]:
    return dict(zip(channels, map(float, values), strict=True))


def _box(
    shape: Callable[[Mapping[str, float]], Lines], names: Sequence[str], paths: list[Array]
) -> Any:
    """Limits of x and y that hold all that was wanted, and what goes astray within its size."""
    points = [np.concatenate(shape(_seen(names, v))) for v in paths[0]]
    low, high = np.min([p.min(0) for p in points], 0), np.max([p.max(0) for p in points], 0)
    size = max(float((high - low).max()), 1e-3)
    middle = (low + high) / 2.0
    return [(m - 0.75 * size, m + 0.75 * size) for m in middle]
