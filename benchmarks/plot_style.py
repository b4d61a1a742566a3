"""The look of the benchmarks' figures; no pyplot, so no global state."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diffsim.core.files import write_bytes_atomic
from diffsim.viz.figures import INK, LINE, SOFT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

Rows = list[dict[str, Any]]


def style(ax: Axes, title: str, xlabel: str, ylabel: str = "") -> None:
    """The look of diffsim's reports."""
    ax.set_title(title, loc="left", fontsize=10, color=INK, fontweight="bold")
    ax.set_xlabel(xlabel, color=SOFT, fontsize=9)
    ax.set_ylabel(ylabel, color=SOFT, fontsize=9)
    ax.tick_params(colors=SOFT, labelsize=8)
    ax.grid(True, which="major", color=LINE, linewidth=0.6)
    ax.set_axisbelow(True)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(LINE)


def new_figure(width: float, height: float) -> Figure:
    """A white figure whose parts keep out of each other's way."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


def save(figure: Figure, path: Path) -> None:
    """Write ``path`` with the suffixes .png and .svg."""
    for suffix in ("png", "svg"):
        content = io.BytesIO()
        figure.savefig(content, format=suffix, dpi=160)
        write_bytes_atomic(path.with_name(f"{path.name}.{suffix}"), content.getvalue())


def legend_below(figure: Figure, axes: Sequence[Axes], columns: int) -> None:
    """One legend for all panels: every label once."""
    entries = {
        label: handle
        for ax in axes
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        list(entries.values()),
        list(entries),
        loc="outside lower center",
        ncols=columns,
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
    )


def select(rows: Rows, **wanted: Any) -> Rows:
    """Rows whose entries equal all of ``wanted``."""
    return [r for r in rows if all(r.get(k) == v for k, v in wanted.items())]


def number_in_steps_of_1_2_5(axis: Axis) -> None:
    """Plain numbers on a logarithmic axis."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

    axis.set_major_locator(FixedLocator([m * 10.0**k for k in range(-3, 9) for m in (1, 2, 5)]))
    axis.set_major_formatter(
        FuncFormatter(lambda x, _: f"{x:,.4g}" if x < 1e4 else f"{x / 1e3:,.4g}k")
    )
    axis.set_minor_formatter(NullFormatter())
