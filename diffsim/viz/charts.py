"""Interactive charts of pages: plotly, zoomed by dragging and read by hovering.

The page holds plotly's script once, gzipped, so it needs no network and stays below 3 MB. Lines of
more than ``MAX_POINTS`` samples are thinned evenly; zoom shows what is drawn, not what was recorded
in between.
"""

from __future__ import annotations

import base64
import gzip
import re
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from diffsim.core.arrays import Array, IntArray
from diffsim.core.optional import optional
from diffsim.viz.figures import COLORS, INK, LINE, SOFT

MAX_POINTS = 2500  # of a line: what a screen can show, and a page of a few megabytes
CHART_POINTS = 300_000  # of all lines of a chart: 5 MB
FEWEST_POINTS = 200  # of a line, however many there are
DIGITS = 5  # of the numbers in the page
ROW_PX = 230
_TOP_PX, _BOTTOM_PX = 64, 50  # above and below the panels
_LEGEND_PX = 26  # above the panels, clear of their titles

NULL, EXTENDED = COLORS["published"], COLORS["fitted"]


def graph_objects() -> Any:
    """plotly's ``graph_objects``.

    Raises:
        ImportError: plotly is not installed.
    """
    return optional("plotly.graph_objects", purpose="an interactive page")


def grid(rows: int, columns: int = 1, *, titles: Sequence[str] = (), **options: Any) -> Any:
    """An empty figure of panels in the style of the pages.

    Args:
        rows, columns: Number of panels down and across.
        titles: Title of each panel, row by row.
        **options: Passed to plotly's ``make_subplots``.
    """
    subplots = optional("plotly.subplots", purpose="an interactive page")
    figure = subplots.make_subplots(
        rows=rows, cols=columns, subplot_titles=list(titles) or None, **options
    )
    return styled(figure, height=ROW_PX * rows + 110)


def styled(figure: Any, *, height: int) -> Any:
    """The figure with colors, fonts and margins of the pages.

    Args:
        figure: A plotly figure, changed in place.
        height: Height [px].
    """
    figure.update_layout(
        height=height,
        template="plotly_white",
        font={"family": "system-ui, Segoe UI, Helvetica Neue, sans-serif", "size": 12},
        font_color=INK,
        margin={"l": 70, "r": 20, "t": _TOP_PX, "b": _BOTTOM_PX},
        paper_bgcolor="rgba(0,0,0,0)",
        plot_bgcolor="rgba(0,0,0,0)",
        legend={
            "orientation": "h",
            "yanchor": "bottom",
            "y": 1.0 + _LEGEND_PX / (height - _TOP_PX - _BOTTOM_PX),
            "x": 0.0,
        },
        hovermode="closest",
    )
    axes = {"gridcolor": LINE, "zerolinecolor": LINE, "exponentformat": "power"}
    figure.update_xaxes(**axes)
    figure.update_yaxes(**axes)
    figure.update_annotations(font_size=12, font_color=SOFT)
    return figure


def line(
    x: Array, y: Array, name: str, color: str, *, most: int = MAX_POINTS, **options: Any
) -> Any:
    """One line or cloud of dots, thinned and rounded.

    Args:
        x, y: Samples, (n,); what is not finite is a gap.
        name: Text in the legend and in the hover box.
        color: Color of the line, as CSS writes it.
        most: Largest number of samples.
        **options: Passed to plotly's ``Scatter``.
    """
    keep = thinned(len(x), most)
    return graph_objects().Scatter(
        x=rounded(x[keep]),
        y=rounded(y[keep]),
        name=name,
        legendgroup=name,
        **{"mode": "lines", "line": {"color": color, "width": 1.6}, **options},
    )


def dots(color: str, size: float = 4.0, opacity: float = 0.8) -> dict[str, Any]:
    """Options of ``line`` that draw dots."""
    return {"mode": "markers", "marker": {"color": color, "size": size, "opacity": opacity}}


def thinned(count: int, most: int = MAX_POINTS) -> IntArray:
    """Indices of at most ``most`` of ``count`` samples, evenly."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def points_per_line(num_lines: int) -> int:
    """How many samples each of many lines may have, so that a page stays a few megabytes."""
    return int(np.clip(CHART_POINTS // max(num_lines, 1), FEWEST_POINTS, MAX_POINTS))


def rounded(values: Array) -> list[float | None]:
    """Numbers of ``DIGITS`` digits; None where not finite."""
    return [
        float(f"{v:.{DIGITS}g}") if np.isfinite(v) else None
        for v in np.asarray(values, dtype=np.float64)
    ]


def chooser(
    labels: Sequence[str], owners: Sequence[int], num_always: int = 0, name: str = "run"
) -> dict[str, Any]:
    """A drop-down menu that shows the lines of one label at a time.

    Pages draw it above the chart, as a menu of the page (``templates/charts.js``).

    Args:
        labels: Entries of the menu; the first is shown at the start.
        owners: Index of the label that each line belongs to, in the order of the lines.
        num_always: Number of lines before them that always show.
    """
    buttons = [
        {
            "label": label,
            "method": "update",
            "args": [{"visible": [True] * num_always + [owner == k for owner in owners]}],
        }
        for k, label in enumerate(labels)
    ]
    return {"buttons": buttons, "name": name}


def to_html(figure: Any) -> str:
    """The figure as HTML without plotly's script; its own waits until that is unpacked."""
    made: str = figure.to_html(
        full_html=False,
        include_plotlyjs=False,
        default_width="100%",
        config={"displayModeBar": False, "responsive": True},
    )
    return re.sub(r"<script[^>]*>", '<script type="text/x-chart">', made)


@cache  # a second to pack
def packed_script() -> str:
    """plotly's script, gzipped, as base64: stands once in a page, with ``templates/charts.js``."""
    offline = optional("plotly.offline", purpose="an interactive page")
    packed = gzip.compress(offline.get_plotlyjs().encode("utf-8"), mtime=0)
    return base64.b64encode(packed).decode("ascii")
