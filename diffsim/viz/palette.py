"""Small PNGs of matplotlib figures."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

from diffsim.core.files import write_bytes_atomic

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def save(figure: Figure, path: str | Path, dpi: int = 110) -> Path:
    """Write a PNG with a palette of 256 colors and close the figure."""
    from matplotlib.pyplot import close
    from PIL import Image

    drawn, small = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=dpi)
    close(figure)
    with Image.open(drawn) as picture:
        palette = picture.convert("RGB").quantize(256, dither=Image.Dither.NONE)
    palette.save(small, format="png", optimize=True)
    return write_bytes_atomic(path, small.getvalue())
