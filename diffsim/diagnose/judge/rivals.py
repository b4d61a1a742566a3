"""What else may be said of judged runs: the model without each cause, the command itself.

Each rival gets what the extended model gets of a run: its own values are fitted anew, a constant
its zero, a command its delay and its zero.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.figures import figure
from diffsim.core.units import after_number, small_scale
from diffsim.data.shown import shown_change
from diffsim.data.study import Channel, Command, Run, Study
from diffsim.diagnose.judge.records import ErrorRow, pooled_by_kind
from diffsim.diagnose.judge.unseen import Unseen
from diffsim.identify.effect import Effect, effect_coordinates
from diffsim.identify.model_file import SavedModel


def without_each(saved: SavedModel, effects: Sequence[Effect]) -> dict[str, SavedModel]:
    """The saved model without each of its causes, all else as it is, by name of the cause."""
    out = {}
    for effect in effects:
        own = set(effect_coordinates([effect]))
        kept = tuple(c for c in saved.components if c not in own)
        out[effect.name] = replace(saved, components=kept)
    return out


def beside_no_skill(found: Unseen, study: Study) -> tuple[ErrorRow, ...]:
    """The errors of judged runs, with what takes no skill as free as the model was.

    A constant has its zero fitted to the run where a value in the channel's unit was, and the
    command itself its delay and zero, where one has the unit of the channel.

    Args:
        found: Answer about the runs.
        study: Study that holds them.
    """
    runs = {run.name: run for run in study.runs}
    out = []
    for row in found.errors:
        run, free = runs[row.run], {own.unit for own in found.own if own.run == row.run}
        own = [
            (c, channel)
            for c, channel in enumerate(study.channels)
            if (channel.kind, channel.shown_unit or channel.unit) == (row.kind, row.unit)
        ]
        if own and all(channel.unit in free for _, channel in own):
            row = replace(
                row, constant=_rms(run, own, lambda run, c: float(np.nanmean(run.measured[:, c])))
            )
        if own and all(_commands_of(channel, study.commands) for _, channel in own):
            row = replace(row, command=_rms(run, own, _late_command(study)))
        out.append(row)
    return tuple(out)


def _commands_of(channel: Channel, commands: Sequence[Command]) -> list[str]:
    return [c.name for c in commands if c.unit == channel.unit and c.unit not in (None, "-")]


def _late_command(study: Study) -> Callable[[Run, int], Array]:
    """What a command says of a channel: that one, so late and so far shifted, that leaves least."""

    def said(run: Run, c: int) -> Array:
        # it may come late by a quarter of the run
        delays = np.linspace(0.0, 0.25 * float(np.ptp(run.time_s)), 65)
        tried = [
            np.interp(run.time_s - delay, run.time_s, np.asarray(run.command[name], dtype=float))
            for name in _commands_of(study.channels[c], study.commands)
            if name in run.command
            for delay in delays
        ] or [np.full(len(run.time_s), np.nan)]
        left = [run.measured[:, c] - values for values in tried]
        best = int(np.argmin([np.nanstd(values) for values in left]))
        return np.asarray(tried[best] + np.nanmean(left[best]))

    return said


def _rms(
    run: Run, own: Sequence[tuple[int, Channel]], said: Callable[[Run, int], Array | float]
) -> float | None:
    """Root mean square of what is left of channels, in the unit in which they are shown."""
    left = [
        shown_change(channel, run.measured[:, c], run.measured[:, c] - said(run, c))
        for c, channel in own
    ]
    value = float(np.sqrt(np.nanmean(np.square(left))))
    return value if np.isfinite(value) else None


def cause_words(causes: Mapping[str, Unseen], words: Mapping[str, str]) -> list[str]:
    """What each cause does on judged runs, a sentence for each.

    Args:
        causes: By name: the model without the cause, and with it.
        words: Names of causes in plain words.
    """
    out = []
    for name, found in causes.items():
        if found.gain is None:
            out.append(f"Without {words[name]} a run cannot be simulated.")
            continue
        said = "; ".join(map(_change, pooled_by_kind(found.errors)))
        if found.gain.status == "withdrawn":
            out.append(
                f"Withdrawn for these runs: {words[name]} makes them worse; without it {said}."
            )
        else:
            share = f"{100 * found.gain.value:.0f} % of the error above the noise removed: "
            share = share if found.gain.has_share else ""
            out.append(f"Without {words[name]}: {said}; {share}{found.gain.status}.")
    return out


def _change(row: ErrorRow) -> str:
    unit, times = small_scale(row.unit, (row.before, row.after))
    before, after = (figure(times * v) for v in (row.before, row.after))
    return f"{row.kind} {before}, with it {after}{after_number(unit)}"
