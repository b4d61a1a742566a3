"""A window for ``render_mode="human"``, by whatever matplotlib finds on this machine."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

_TOOLKITS = ("macosx", "qtagg", "tkagg", "gtk4agg", "gtk3agg", "wxagg")
_HINT = (
    'render_mode="human" needs a window, and none can be opened here ({why}). Without a display, '
    'make the environment with render_mode="rgb_array": render() returns pictures, and '
    "gymnasium.wrappers.RecordVideo makes films of them (pip install 'gymnasium[other]'). With a "
    "display, a toolkit is missing: pip install PyQt6, or apt install python3-tk"
)


def _interactive() -> str | None:
    """A backend of matplotlib that opens windows here: the one in use, or the first that loads."""
    import matplotlib
    from matplotlib import pyplot

    used = matplotlib.get_backend().lower()
    for name in dict.fromkeys([used, *_TOOLKITS] if used in _TOOLKITS else _TOOLKITS):
        try:
            pyplot.switch_backend(name)
        except ImportError:  # the toolkit, or a display, is missing
            continue
        return name
    pyplot.switch_backend(used)
    return None


class PictureWindow:
    """Shows pictures one after the other, at most as fast as they happened.

    Args:
        fps: Pictures per second.

    Raises:
        gymnasium.error.DependencyNotInstalled: no window can be opened; the message says what to
            do instead.
    """

    def __init__(self, title: str, fps: float):
        backend = _interactive()
        if backend is None:
            raise gymnasium.error.DependencyNotInstalled(_HINT.format(why="no display or toolkit"))
        self.title, self.period = title, 1.0 / fps
        self.shown: NDArray[np.uint8] | None = None
        self._next = 0.0
        self._figure: Any = None
        self._image: Any = None

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Draw (height, width, 3)."""
        if self._figure is None:
            self._open(picture)
        self._image.set_data(picture)
        self.shown = picture
        canvas = self._figure.canvas
        canvas.draw_idle()
        canvas.flush_events()
        time.sleep(max(0.0, self._next - time.monotonic()))
        self._next = time.monotonic() + self.period

    def close(self) -> None:
        """Close the window."""
        from matplotlib import pyplot

        if self._figure is not None:
            pyplot.close(self._figure)
        self._figure = None

    def _open(self, picture: NDArray[np.uint8]) -> None:
        from matplotlib import pyplot

        height, width = picture.shape[:2]
        try:
            self._figure = pyplot.figure(self.title, figsize=(width / 100, height / 100), dpi=100)
        except Exception as error:  # every toolkit has its own kind, such as TclError
            raise gymnasium.error.DependencyNotInstalled(_HINT.format(why=error)) from error
        axes = self._figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        self._image = axes.imshow(picture)
        if getattr(self._figure.canvas, "required_interactive_framework", None) is not None:
            pyplot.show(block=False)


def side_by_side(pictures: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Pictures of equal size as one, in a square of rows; white where there is none."""
    columns = math.ceil(math.sqrt(len(pictures)))
    rows = math.ceil(len(pictures) / columns)
    blank = np.full_like(pictures[0], 255)
    filled = [*pictures, *[blank] * (rows * columns - len(pictures))]
    return np.concatenate(
        [np.concatenate(filled[r * columns : (r + 1) * columns], 1) for r in range(rows)]
    )
