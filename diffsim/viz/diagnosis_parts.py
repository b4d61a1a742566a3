"""Parts that the pages of a diagnosis and of a judgment share: key figures, runs over time."""

from __future__ import annotations

from collections.abc import Sequence

from diffsim.core.figures import figure, unit_of
from diffsim.core.units import small_scale
from diffsim.data.study import Channel
from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.records import LEVEL, ErrorRow, band_share, pooled_by_kind
from diffsim.viz import diagnosis_charts as draw
from diffsim.viz import report as page
from diffsim.viz.diagnosis_series import PredictedRun
from diffsim.viz.moving import MovingChoice

NEAR_LEVEL = 0.05  # share of the readings by which a band may be off
_TONES = {"confirmed": "good", "not confirmed": "fair", "withdrawn": "bad"}


def error_numbers(errors: Sequence[ErrorRow]) -> list[page.Number]:
    """Error before and after in the unit of the first sentence, for each kind of channel."""
    shown = []
    for row in pooled_by_kind(errors):
        unit, times = small_scale(row.unit, (row.after, row.noise))
        before, after, noise = (figure(times * v) for v in (row.before, row.after, row.noise))
        shown.append(
            page.Number(
                label=f"rms error of {row.kind} on {row.use} runs",
                value=after,
                unit=unit_of(unit),
                note=f"before: {before}, noise alone: {noise}",
            )
        )
    return shown


def gain_numbers(gain: Gain | None) -> list[page.Number]:
    """The gain on test runs as a key figure; none where a share says nothing."""
    if gain is None or not gain.has_share:
        return []
    return [
        page.Number(
            label=f"share of the error above the noise removed on test runs: {gain.status}",
            value=f"{100 * gain.value:.0f}",
            unit="%",
            note=f"90 % interval {100 * gain.low:.0f} to {100 * gain.high:.0f} %"
            + (_beyond_all(gain) if gain.value > 1.0 else ""),
            tone=_TONES.get(gain.status, "fair"),
        )
    ]


def _beyond_all(gain: Gain) -> str:
    is_off = gain.is_below_noise
    return "; the noise is not as stated" if is_off else "; beyond 100: below the noise as stated"


def band_numbers(errors: Sequence[ErrorRow]) -> list[page.Number]:
    """Share of the readings of test runs inside their band, as a key figure; none where unknown."""
    if (share := band_share(errors)) is None:
        return []
    return [
        page.Number(
            label=f"readings of test runs inside the {100 * LEVEL:.0f} % band",
            value=f"{100 * share:.0f}",
            unit="%",
            note="of noise, parameters and what was left on runs that were not fitted",
            tone="good" if abs(share - LEVEL) <= NEAR_LEVEL else "fair",
        )
    ]


def runs_section(
    title: str,
    runs: Sequence[PredictedRun],
    channels: Sequence[Channel],
    view: MovingChoice | None = None,
) -> page.Section:
    """Runs over time, measured and predicted.

    Args:
        runs: Runs with their predictions, one or more.
        channels: Channels of the study with their noise.
        view: What moved in these runs; None: nothing to see.
    """
    has_band = any(run.band is not None for run in runs)
    what = "measured" if has_band else "measured, with the noise"
    caption = f"Dots: {what}. Dashed: the fitted model before. "
    if any(run.extended is not None for run in runs):
        caption += "Line: the extended model. "
    if has_band:
        caption += f"Grey: where {100 * LEVEL:.0f} % of the readings are expected. "
    caption += "The menu chooses the run; drag" if len(runs) > 1 else "Drag"
    caption += " to zoom, double-click to zoom out."
    text, seen = [], len(draw.seen_channels(runs))
    if seen > draw.MAX_PANELS:
        text.append(f"The first {draw.MAX_PANELS} of {seen} channels.")
    longest, most = max(len(run.time_s) for run in runs), draw.points_drawn(runs)
    if longest > most:
        text.append(f"Of the {longest} samples of the longest run {most} are drawn, evenly.")
    content: list[page.Item] = [] if view is None else [view]
    content.append(page.Chart(figure=draw.runs_over_time(runs, channels), caption=caption))
    return page.Section(title=title, text=text, content=content)
