"""Films without a player: animated GIFs by Pillow, which comes with matplotlib."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffsim.core.files import write_bytes_atomic

COLORS = 64  # of a frame; the pictures of environments have few


def write_gif(path: str | Path, pictures: Sequence[NDArray[np.uint8]], fps: float) -> Path:
    """Write pictures as an animation that repeats.

    Args:
        path: Path of the file that is written.
        pictures: (height, width, 3) each, at least one.
        fps: Pictures per second, at most 50: players show faster ones at 10.

    Raises:
        ValueError: no pictures, or a frame rate that GIFs do not have.
    """
    from PIL import Image

    if not len(pictures):
        raise ValueError("pictures is empty; a film needs at least one")
    if not 0.0 < fps <= 50.0:
        raise ValueError(f"fps must be above 0 and at most 50, got {fps:g}")
    frames = [Image.fromarray(picture).quantize(COLORS) for picture in pictures]
    content = io.BytesIO()
    frames[0].save(
        content,
        format="GIF",
        save_all=True,
        append_images=frames[1:],
        duration=round(1000.0 / fps),
        loop=0,
    )
    return write_bytes_atomic(Path(path), content.getvalue())
