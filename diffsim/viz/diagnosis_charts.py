"""Interactive charts of a diagnosis: runs, residuals, force map, confounding, next runs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from scipy import special

from diffsim.core.arrays import Array
from diffsim.core.units import small_scale
from diffsim.data.shown import shown, shown_change
from diffsim.data.study import Channel
from diffsim.viz import charts
from diffsim.viz.charts import EXTENDED, NULL
from diffsim.viz.diagnosis_series import (
    CONFOUNDED,
    PredictedRun,
    binned_rms,
    blocks_of,
    command_phase,
    mean_periodogram,
    rms_of,
)
from diffsim.viz.figures import INK, LINE, SOFT

_KNOT = re.compile(r"(?P<shape>.*?)(?P<knot>\d+)")
BAND_LABEL = "90 % band"
MAX_LABEL = 40  # characters beside a matrix
_LABEL_PX = 18
MAX_PANELS = 24  # channels in one chart; more are drawn by their misfit, and said
_BAND = 1.96  # 95 % of noise alone
_SCALE = [[0.0, "#2a6f97"], [0.5, "#f7f7f5"], [1.0, "#b3362a"]]


def runs_over_time(runs: Sequence[PredictedRun], channels: Sequence[Channel]) -> Any:
    """Channels over time, a menu for the run; beside each what is left of it.

    Args:
        runs: Runs with their predictions, one or more.
        channels: Channels of the study, in the order of the records, with their noise.
    """
    shown = seen_channels(runs)[:MAX_PANELS]
    scales = {i: _scale_of_misfits(runs, i, channels[i]) for i in shown}
    titles = []
    for i in shown:
        unit = channels[i].shown_unit or channels[i].unit
        titles += [f"{channels[i].name} [{unit}]", f"measured minus predicted [{scales[i][0]}]"]
    figure = charts.grid(
        len(shown),
        2,
        titles=titles,
        shared_xaxes="all",
        column_widths=[0.56, 0.44],
        vertical_spacing=0.35 / max(len(shown), 2),
    )
    owners, most = [], points_drawn(runs)
    for k, run in enumerate(runs):
        for row, i in enumerate(shown, start=1):
            signals = _signals(run, i, channels[i], most)
            left = _draw_misfits(run, i, channels[i], most, scales[i][1])
            for drawn in (*signals, *left):
                drawn.visible = k == 0
                drawn.showlegend = row == 1 and drawn in signals
            figure.add_traces(signals, rows=[row] * len(signals), cols=[1] * len(signals))
            figure.add_traces(left, rows=[row] * len(left), cols=[2] * len(left))
            owners += [k] * (len(signals) + len(left))
    if len(runs) > 1:
        menu = charts.chooser([f"{run.name} ({run.use})" for run in runs], owners)
        figure.update_layout(updatemenus=[menu])
    figure.update_xaxes(title_text="time [s]", row=len(shown))
    return figure


def points_drawn(runs: Sequence[PredictedRun]) -> int:
    """Largest number of samples that ``runs_over_time`` draws of a line."""
    panels = min(len(seen_channels(runs)), MAX_PANELS)
    # three signals, two that are left, and both edges of a band in either panel
    lines = 5 + 4 * any(run.band is not None for run in runs)
    return charts.points_per_line(lines * panels * len(runs))


def seen_channels(runs: Sequence[PredictedRun]) -> list[int]:
    """Channels that one of the runs measured; all of them if none did."""
    seen = np.any([np.isfinite(run.measured).any(0) for run in runs], axis=0)
    return [int(i) for i in np.flatnonzero(seen)] or list(range(len(seen)))


def _signals(run: PredictedRun, i: int, channel: Channel, most: int) -> list[Any]:
    """Lines of one channel in one run, in the unit of the recordings' files."""
    t, read = run.time_s, partial(shown, channel)
    last = run.null if run.extended is None else run.extended
    lines = _draw_band(run, i, channel, most, around=last[:, i])
    before = {"color": NULL, "width": 1.4, "dash": "dash"}
    lines.append(charts.line(t, read(run.null[:, i]), "model before", NULL, line=before, most=most))
    if run.extended is not None:
        after = read(run.extended[:, i])
        lines.append(charts.line(t, after, "extended model", EXTENDED, most=most))
    error: dict[str, Any] | None = None
    if channel.sd is not None and run.band is None:  # which holds the noise
        error = {**_noise_bars(channel, run.measured[:, i], most), "thickness": 0.7, "width": 0}
    measured = read(run.measured[:, i])
    look = {"error_y": error, **charts.dots(INK, 3.5)}
    name = "measured" if error is None else "measured ± noise"
    lines.append(charts.line(t, measured, name, INK, most=most, **look))
    return lines


def _noise_bars(channel: Channel, measured: Array, most: int) -> dict[str, Any]:
    """One noise sd as it is shown: a number, or of a scaled reading one for each sample."""
    bars = shown_change(channel, measured, np.full(len(measured), channel.sd))
    if channel.shown_formula is None:
        return {"type": "constant", "value": bars[0]}
    return {"array": charts.rounded(bars[charts.thinned(len(bars), most)])}


def _draw_band(
    run: PredictedRun,
    i: int,
    channel: Channel,
    most: int,
    *,
    around: Array | None = None,
    times: float = 1.0,
) -> list[Any]:
    """Where readings of one channel are expected in one run, or how far off, ``times`` as large;
    nothing where it has no band."""
    if run.band is None or not np.isfinite(half := run.band[:, i]).any():
        return []
    if around is None:
        above = times * shown_change(channel, run.measured[:, i], half)
        edges = above, -above
    else:
        edges = shown(channel, around + half), shown(channel, around - half)
    keep = charts.thinned(len(run.time_s), most)
    both = np.concatenate([keep, keep[::-1]])
    edge = np.concatenate([edges[0][keep], edges[1][keep[::-1]]])
    look = {"fill": "toself", "fillcolor": LINE, "line": {"width": 0}, "hoverinfo": "skip"}
    area = charts.line(run.time_s[both], edge, BAND_LABEL, LINE, most=2 * most, **look)
    return [area]


def _scale_of_misfits(runs: Sequence[PredictedRun], i: int, channel: Channel) -> tuple[str, float]:
    """Unit in which what is left of a channel is read, as sentences have it, and the factor."""
    left = (shown_change(channel, r.measured[:, i], r.measured[:, i] - r.null[:, i]) for r in runs)
    return small_scale(
        channel.shown_unit or channel.unit,
        [float(np.abs(v[np.isfinite(v)]).max(initial=0.0)) for v in left],
    )


def _draw_misfits(
    run: PredictedRun, i: int, channel: Channel, most: int, times: float
) -> list[Any]:
    """What is left of one channel in one run, before and after, ``times`` as large."""
    kinds = [("model before", NULL, run.null)]
    if run.extended is not None:
        kinds.append(("extended model", EXTENDED, run.extended))
    band = _draw_band(run, i, channel, most, times=times)
    return band + [
        charts.line(
            run.time_s,
            times * shown_change(channel, run.measured[:, i], run.measured[:, i] - predicted[:, i]),
            name,
            color,
            most=most,
            **charts.dots(color, 3.5, 0.7),
        )
        for name, color, predicted in kinds
    ]


def residual_views(
    runs: Sequence[PredictedRun], channels: Sequence[Channel], command: str | None = None
) -> Any:
    """Residuals in noise standard deviations over time, command, frequency and channel.

    Args:
        runs: Runs with their predictions, one or more.
        channels: All channels of the study, with their noise.
        command: Command whose value and rate give the phase; None: the first one that changes.
    """
    varying = (n for n in runs[0].command if any(np.ptp(r.command[n]) > 0.0 for r in runs))
    command = command or next(varying, None)
    still = command is None
    titles = ["over time", "spectrum; 1: white noise", "rms per channel; 1: noise"]
    figure = charts.grid(
        2,
        2,
        titles=titles if still else [titles[0], "over the command", *titles[1:]],
        specs=[[{"colspan": 2}, None] if still else [{}, {}], [{}, {}]],
        vertical_spacing=0.24,
    )
    kinds = _kinds(runs, channels)
    for name, color, left in kinds:
        options = charts.dots(color, 3.0, 0.45)
        t = np.concatenate([np.repeat(r.time_s, left[r.name].shape[1]) for r in runs])
        y = np.concatenate([left[r.name].ravel() for r in runs])
        figure.add_trace(charts.line(t, y, name, color, **options), row=1, col=1)
        if command is not None:
            x = np.concatenate(
                [np.repeat(_phase(runs, r, command), left[r.name].shape[1]) for r in runs]
            )
            figure.add_trace(
                charts.line(x, y, name, color, showlegend=False, **options), row=1, col=2
            )
        frequency, power = mean_periodogram([(r.time_s, left[r.name]) for r in runs])
        figure.add_trace(
            charts.line(frequency[1:], power[1:], name, color, showlegend=False), row=2, col=1
        )
        rms = rms_of(np.concatenate([left[r.name] for r in runs]))
        bar = charts.graph_objects().Bar(
            x=[c.name for c in channels],
            y=charts.rounded(rms),
            name=name,
            legendgroup=name,
            showlegend=False,
            marker_color=color,
        )
        figure.add_trace(bar, row=2, col=2)
    for column in (1,) if still else (1, 2):
        figure.add_hrect(
            y0=-_BAND, y1=_BAND, fillcolor=LINE, opacity=0.6, line_width=0, layer="below",
            row=1, col=column,
        )  # fmt: skip
    count = 2 * len(runs) * len(channels)
    low, high = special.chdtri(count, [0.975, 0.025]) / count
    figure.add_hrect(
        y0=low, y1=high, fillcolor=LINE, opacity=0.6, line_width=0,
        layer="below", row=2, col=1,
    )  # fmt: skip
    figure.add_hline(y=1.0, line={"color": SOFT, "width": 1, "dash": "dot"}, row=2, col=2)
    figure.update_yaxes(title_text="residual [noise sd]", row=1)
    figure.update_yaxes(type="log", title_text="power [noise variances]", row=2, col=1)
    figure.update_yaxes(title_text="rms [noise sd]", row=2, col=2)
    figure.update_xaxes(title_text="time [s]", row=1, col=1)
    if command is not None:
        figure.update_xaxes(title_text=_phase_title(runs, command), row=1, col=2)
    figure.update_xaxes(title_text="frequency [Hz]", row=2, col=1)
    figure.update_layout(legend_itemsizing="constant")  # small pale dots are not seen there
    return figure


def over_position(
    runs: Sequence[PredictedRun], channels: Sequence[Channel], most: int = 3
) -> Any | None:
    """Residuals of all channels over where the system is, a panel per position channel.

    Lines: rms in ten equally filled bins; noise alone has 1.

    Args:
        runs: Runs with their predictions, one or more.
        channels: All channels of the study; positions are those of kind "position".
        most: Largest number of panels; channels of the largest range come first.

    Returns:
        None where no position was measured.
    """
    places = [i for i, c in enumerate(channels) if c.kind == "position"]
    if not places:
        return None
    spans = {i: float(np.ptp(np.concatenate([run.null[:, i] for run in runs]))) for i in places}
    places = sorted(places, key=lambda i: -spans[i])[:most]
    figure = charts.grid(1, len(places), titles=[f"over {channels[i].name}" for i in places])
    for name, color, left in _kinds(runs, channels):
        stacked = np.concatenate([left[r.name] for r in runs])
        for panel, i in enumerate(places):
            x = shown(channels[i], np.concatenate([r.null[:, i] for r in runs]))
            wide = np.repeat(x[:, None], stacked.shape[1], 1)
            cloud = charts.line(
                wide.ravel(), stacked.ravel(), name, color, showlegend=False,
                **charts.dots(color, 2.5, 0.25),
            )  # fmt: skip
            middle, rms = binned_rms(x, stacked)
            curve = charts.line(
                middle, rms, name, color, mode="lines+markers", showlegend=panel == 0
            )
            figure.add_traces([cloud, curve], rows=[1, 1], cols=[panel + 1] * 2)
            figure.add_hrect(
                y0=-_BAND, y1=_BAND, fillcolor=LINE, opacity=0.6, line_width=0, layer="below",
                row=1, col=panel + 1,
            )  # fmt: skip
    for panel, i in enumerate(places, start=1):
        unit = channels[i].shown_unit or channels[i].unit
        figure.update_xaxes(title_text=f"{channels[i].name}, predicted [{unit}]", col=panel)
    figure.update_yaxes(title_text="residual [noise sd]", col=1)
    return figure


def confounding_matrix(names: Sequence[str], confounding: Array, bar: str = "cosine") -> Any:
    """Cosines between the responses of candidates; sets that the data hardly part are boxed.

    Args:
        names: Names of the components, (n,).
        confounding: Cosines between the responses of components, (n, n), in the order of ``names``.
        bar: What the colors mean.
    """
    blocks = blocks_of(confounding, CONFOUNDED)
    grouped = [i for block in blocks for i in block]
    order = grouped + [i for i in range(len(names)) if i not in set(grouped)]
    labels = [names[i] for i in order]
    figure = _heat_map(confounding[np.ix_(order, order)], labels, labels, 1.0, bar)
    short = [_shorten_label(label) for label in labels]
    ticks = {"tickmode": "array", "tickvals": list(range(len(labels))), "ticktext": short}
    figure.update_xaxes(**ticks, tickangle=45)
    figure.update_yaxes(**ticks)
    start = 0
    for block in blocks:
        a, b = start - 0.5, start + len(block) - 0.5
        figure.add_shape(type="rect", x0=a, x1=b, y0=a, y1=b, line={"color": INK, "width": 2})
        start += len(block)
    figure.update_yaxes(autorange="reversed")
    return charts.styled(figure, height=260 + _LABEL_PX * len(names))


def _shorten_label(label: str) -> str:
    """A label that leaves room for the matrix: its begin and its end."""
    half = MAX_LABEL // 2
    return label if len(label) <= MAX_LABEL else f"{label[: half - 1]}…{label[-half:]}"


def force_map(components: Sequence[str], groups: Sequence[str], z: Array) -> Any:
    """Scores of a generic force: a menu for the command, a row per shape, knots in time.

    Args:
        components: Names of the force's components; a number at the end is the knot in time.
        groups: Names of the commands.
        z: Scores, (num_groups, num_components) [noise standard deviations].
    """
    parts = [_KNOT.fullmatch(name) for name in components]
    shapes = [m["shape"].strip("_") if m else n for m, n in zip(parts, components, strict=True)]
    knots = [int(m["knot"]) if m else 0 for m in parts]
    rows = list(dict.fromkeys(shapes))
    high = max(float(np.abs(z).max(initial=0.0)), 5.0)  # noise alone stays pale
    figure = charts.graph_objects().Figure()
    for k, scores in enumerate(z):
        table = np.full((len(rows), max(knots) + 1), np.nan)
        for shape, knot, score in zip(shapes, knots, scores, strict=True):
            table[rows.index(shape), knot] = score
        drawn = _draw_heat_map(table, [str(i) for i in range(table.shape[1])], rows, high, "score")
        drawn.visible = k == 0
        figure.add_trace(drawn)
    if len(groups) > 1:
        menu = charts.chooser(list(groups), list(range(len(groups))), name="command")
        figure.update_layout(updatemenus=[menu])
    figure.update_xaxes(title_text="knot in time")
    return charts.styled(figure, height=200 + 40 * len(rows))


def next_run_bars(apart: Mapping[str, float], best: str) -> Any:
    """How far each run would part the nearest rivals, as bars.

    Args:
        apart: Distance of the nearest two by name of the run [noise sd].
        best: Name of the run that is advised.
    """
    names = sorted(apart, key=lambda name: apart[name])
    bars = charts.graph_objects().Bar(
        x=charts.rounded(np.array([apart[n] for n in names])),
        y=names,
        orientation="h",
        marker_color=[EXTENDED if n == best else SOFT for n in names],
    )
    figure = charts.graph_objects().Figure(bars)
    figure.update_xaxes(title_text="noise sd between the nearest two")
    return charts.styled(figure, height=140 + 26 * len(names))


def _heat_map(table: Array, x: Sequence[str], y: Sequence[str], high: float, bar: str) -> Any:
    return charts.graph_objects().Figure(_draw_heat_map(table, x, y, high, bar))


def _draw_heat_map(table: Array, x: Sequence[str], y: Sequence[str], high: float, bar: str) -> Any:
    # what is small beside the scale has not digits of its own, which may be rounding
    places = charts.DIGITS - 1 - int(np.floor(np.log10(high)))
    return charts.graph_objects().Heatmap(
        z=[charts.rounded(np.round(row, places)) for row in table],
        x=list(x),
        y=list(y),
        zmin=-high,
        zmax=high,
        colorscale=_SCALE,
        colorbar={"title": bar},
        hovertemplate="%{y} / %{x}: %{z:.3g}<extra></extra>",
    )


def _kinds(
    runs: Sequence[PredictedRun], channels: Sequence[Channel]
) -> list[tuple[str, str, dict[str, Array]]]:
    """Label, color and residuals by run [noise sd], of the models before and after."""
    sd = np.array([c.sd for c in channels])
    out = [("model before", NULL, {r.name: (r.measured - r.null) / sd for r in runs})]
    if all(r.extended is not None for r in runs):
        after = {r.name: (r.measured - np.asarray(r.extended)) / sd for r in runs}
        out.append(("extended model", EXTENDED, after))
    return out


def _is_turning(runs: Sequence[PredictedRun], command: str) -> bool:
    return all(command_phase(r.time_s, r.command[command]) is not None for r in runs)


def _phase_title(runs: Sequence[PredictedRun], command: str) -> str:
    return f"phase of {command} [rad]" if _is_turning(runs, command) else f"value of {command}"


def _phase(runs: Sequence[PredictedRun], run: PredictedRun, command: str) -> Array:
    """Phase angle of the command where it turns in all runs; else its value."""
    values = run.command[command]
    phase = command_phase(run.time_s, values) if _is_turning(runs, command) else None
    return values if phase is None else phase
