"""The house style of figures, made without pyplot, so no global state is touched.

``new_figure`` gives a ``matplotlib.figure.Figure``; ``data_uri`` turns it into text for a page.
"""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diffsim.core.files import write_bytes_atomic
from diffsim.core.optional import optional

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


INK, SOFT, LINE = "#1d2433", "#5b6475", "#d9dde4"
#: Colors by role; readable for color-blind readers and in grey (Okabe and Ito, darkened).
COLORS = {
    "measured": "#1d2433",
    "measured_2": "#8a93a3",
    "published": "#c2571a",
    "fitted": "#0b6e75",
    "third": "#7a4fa3",
    "fourth": "#b08a00",
    "bad": "#b3362a",
}
CYCLE = ("#0b6e75", "#c2571a", "#7a4fa3", "#b08a00", "#1d2433", "#8a93a3", "#4f8a3c")


def new_figure(
    rows: int = 1, columns: int = 1, *, width: float = 9.6, height: float = 3.4, **kwargs: Any
) -> tuple[Figure, Any]:
    """A figure and its axes (an array if there are several), in the house style."""
    figure_module = optional("matplotlib.figure", purpose="a figure")
    figure = figure_module.Figure(figsize=(width, height), layout="constrained")
    figure.set_facecolor("none")
    axes = figure.subplots(rows, columns, **kwargs)
    for ax in np.atleast_1d(np.asarray(axes, dtype=object)).flat:
        style(ax)
    return figure, axes


def data_uri(figure: Figure, *, png: bool = False, dpi: int = 160) -> str:
    """The figure as a data URI: SVG (sharp, its ids kept apart from other figures'), or PNG."""
    backend = optional(
        "matplotlib.backends.backend_agg" if png else "matplotlib.backends.backend_svg",
        purpose="a figure",
    )
    buffer = io.BytesIO()
    if png:
        figure.set_dpi(dpi)
        backend.FigureCanvasAgg(figure).print_png(buffer)
    else:
        backend.FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    return uri_of(buffer.getvalue(), "png" if png else "svg+xml")


def uri_of(content: bytes, kind: str) -> str:
    """A picture's file as a data URI.

    Args:
        kind: Its kind: "png", "svg+xml".
    """
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"


def save(figure: Figure, path: str | Path, *, dpi: int = 160) -> Path:
    """Write a figure (.png, .svg or .pdf); the file appears whole or not at all."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".png", ".svg", ".pdf"):
        raise ValueError(f"path must end in .png, .svg or .pdf, got {path.name!r}")
    buffer = io.BytesIO()
    face = "none" if suffix == ".svg" else "white"
    figure.savefig(buffer, format=suffix[1:], dpi=dpi, facecolor=face)
    return write_bytes_atomic(path, buffer.getvalue())


def style(ax: Axes) -> None:
    """Spines, ticks and grid as all figures have them."""
    ax.set_facecolor("none")
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color(LINE)
    ax.tick_params(colors=SOFT, labelsize=9, length=3)
    ax.grid(True, color=LINE, lw=0.5, alpha=0.7)
    ax.set_axisbelow(True)
