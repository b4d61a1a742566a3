"""A frozen model on runs that it has not seen: errors in the recordings' unit, gain, distance.

Nothing is fitted to these runs but what the study declares unknown for each of them ("offset@run"),
for the plain and the extended model alike.

A model is fitted where it was excited: the misfit of a lag is seen at any amplitude, that of a
speed limit only above it. So an error on a test run means little without its distance from the
range of the fitted runs: levels, strokes, rates and frequencies, facts of the set-up.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

from diffsim.core.arrays import Array
from diffsim.core.errors import DiffsimError
from diffsim.core.files import to_plain
from diffsim.data.shown import shown_change
from diffsim.data.study import Channel, Command, Run
from diffsim.diagnose.checks.noise import choose_commands, without_spikes
from diffsim.diagnose.checks.one_run import MIN_SAMPLES
from diffsim.diagnose.judge.gain import Gain, compared
from diffsim.diagnose.judge.own_values import Frozen, OwnRow, held_out_point, own_names, own_rows
from diffsim.diagnose.judge.records import RATIOS, ErrorRow, OutsideRow, band_words

TAIL = 0.01  # share of samples on either side that a range leaves out: spikes are none
MARGIN = 1.02  # of the distance from the middle of the range: rounding is not outside
LEAST_WIDTH = 0.1  # half-width of a range over its middle, where all fitted runs are alike
FAST = ("rate of", "frequency of")  # quantities that tell no distance of levels
LEVEL = "level of"  # smallest and largest value alike: what lies between was passed through
OF_ONE_RUN = re.compile(r"([_\- ]*(\d+|(?<=[_\- ])[a-z]))+$")  # what tells runs of a kind apart
OWN_SPIKE_SHARE = 0.5  # of what is left of a sample, that a model itself may make of it there


@dataclass(frozen=True)
class Span:
    """What the fitted runs covered of one quantity."""

    # low, high: smallest and largest value; None for labels
    low: float | None
    high: float | None
    labels: tuple[str, ...] = ()  # labels that occurred; empty for numbers
    unit: str = ""


def constants_of(runs: Sequence[Run], channels: Sequence[Channel]) -> dict[str, float]:
    """The best constant of each channel, by its name: the mean over all samples of runs.

    Args:
        channels: Columns of their ``measured``.
    """
    measured = np.concatenate([run.measured for run in runs])
    seen = [values[np.isfinite(values)] for values in measured.T]
    named = zip(channels, seen, strict=True)
    return {channel.name: float(values.mean()) for channel, values in named if len(values)}


def spans_of(
    runs: Sequence[Run], channels: Sequence[Channel], commands: Sequence[Command] = ()
) -> dict[str, Span]:
    """Range of every quantity over runs, by name of the quantity.

    Args:
        channels: Columns of their ``measured``.
        commands: What is known of commands: their units.
    """
    found: dict[str, list[tuple[float | str, str]]] = {}
    for run in runs:
        for what, value, unit in _quantities(run, channels, commands):
            found.setdefault(what, []).append((value, unit))
    out = {}
    for what, values in found.items():
        numbers = [v for v, _ in values if not isinstance(v, str)]
        labels = sorted({v for v, _ in values if isinstance(v, str)})
        low, high = (min(numbers), max(numbers)) if numbers else (None, None)
        out[what] = Span(low, high, tuple(labels), values[0][1])
    return out


def outside_rows(
    runs: Sequence[Run],
    channels: Sequence[Channel],
    spans: Mapping[str, Span],
    commands: Sequence[Command] = (),
) -> tuple[OutsideRow, ...]:
    """Quantities of runs outside of fitted ranges, the farthest first.

    Args:
        runs: Runs that are judged.
        channels: Columns of their ``measured``.
        spans: Ranges of the fitted runs, as ``spans_of`` returns them.
        commands: What is known of commands: their units.
    """
    rows: dict[tuple[str, str], OutsideRow] = {}
    for run in runs:
        for what, value, unit in _quantities(run, channels, commands):
            if what in spans and (times := _times(what, value, spans[what])) > MARGIN:
                span, key = spans[what], (run.name, what)
                if key not in rows or rows[key].times < times:
                    rows[key] = OutsideRow(run.name, what, value, span.low, span.high, times, unit)
    return tuple(sorted(rows.values(), key=lambda row: -row.times))


def times_outside(rows: Sequence[OutsideRow]) -> float:
    """How far outside runs lie, at least 1, by levels, strokes and facts that are numbers; of
    channels as they are predicted, for a band is there before the record.

    How fast a signal moves is no reach: a step has any rate, by its clock. Labels have no distance.
    """
    return max(
        (row.times for row in rows if not row.what.startswith(FAST) and np.isfinite(row.times)),
        default=1.0,
    )


def _times(what: str, value: float | str, span: Span) -> float:
    """How far outside a value is; at most 1 is inside.

    Strokes and rates over the largest one that was fitted: smaller ones were passed through. All
    else by its distance from the middle of the range over half the width, a tenth of the middle at
    least where all fitted runs are alike.
    """
    if isinstance(value, str):
        return 1.0 if value in span.labels else float("inf")
    if span.low is None or span.high is None:
        return float("inf")
    if what.startswith(RATIOS):
        return value / span.high if span.high > 0.0 else (1.0 if value <= 0.0 else float("inf"))
    middle, half = 0.5 * (span.low + span.high), 0.5 * (span.high - span.low)
    if span.low <= value <= span.high:
        return 1.0
    half = max(half, LEAST_WIDTH * abs(middle))
    return abs(value - middle) / half if half > 0.0 else float("inf")


def _quantities(
    run: Run, channels: Sequence[Channel], commands: Sequence[Command]
) -> list[tuple[str, float | str, str]]:
    """Name, value and unit of everything that says where a run lies."""
    out: list[tuple[str, float | str, str]] = []
    units = {c.name: c.unit for c in commands if c.unit not in (None, "-")}
    for name, values in run.command.items():
        unit = units.get(name) or ""
        out += _of_signal(name, np.asarray(values, dtype=np.float64), run.time_s, unit)
    for channel, values in zip(channels, run.measured.T, strict=True):
        seen = values[np.isfinite(values)]
        if len(seen):
            low, high = np.quantile(seen, [TAIL, 1.0 - TAIL])
            out.append((f"stroke of {channel.name}", float(high - low), channel.unit))
            out += [(f"{LEVEL} {channel.name}", float(v), channel.unit) for v in (low, high)]
    for name, fact in run.setup.items():
        if name.startswith("_"):  # found by the system, such as a start state
            continue
        is_number = isinstance(fact, (int, float)) and not isinstance(fact, bool)
        out.append((name, float(fact) if is_number else str(fact), ""))
    return out


def _of_signal(
    name: str, values: Array, time_s: Array, unit: str
) -> list[tuple[str, float | str, str]]:
    """Ends, rate and frequency of a command; a constant has no frequency."""
    valid = np.isfinite(values)
    values, time_s = values[valid], time_s[valid]
    if not len(values):
        return []
    low, high = np.quantile(values, [TAIL, 1.0 - TAIL])
    out: list[tuple[str, float | str, str]] = [
        (f"{LEVEL} {name}", float(low), unit),
        (f"{LEVEL} {name}", float(high), unit),
    ]
    if len(values) < MIN_SAMPLES or not high > low:
        return out
    slope = np.diff(values) / np.diff(time_s)
    out.append(
        (
            f"rate of {name}",
            float(np.quantile(np.abs(slope), 1.0 - TAIL)),
            f"{unit}/s" if unit else "",
        )
    )
    middle = 0.5 * (values[1:] + values[:-1])
    spread = float(np.average((middle - middle.mean()) ** 2, weights=np.diff(time_s)))
    if spread > 0.0:
        power = float(np.average(slope**2, weights=np.diff(time_s)))
        # a step has no rate of its own: limited by a sample, its frequency is that of the clock
        out.append((f"frequency of {name}", float(np.sqrt(power / spread) / (2 * np.pi)), "Hz"))
    return out


@dataclass(frozen=True, eq=False)
class Unseen:
    """A model and its extension on runs that no fit has seen."""

    runs: tuple[str, ...]  # names of the runs
    errors: tuple[ErrorRow, ...]  # error before and after by run and kind of channel
    # share of the error above the noise that is removed, over all runs; None without any
    gain: Gain | None
    gains: Mapping[str, Gain]  # the same by run
    outside: tuple[OutsideRow, ...]  # where the runs lie outside of what was fitted
    num_spikes: int = 0  # samples that were left out as spikes, for both models
    num_misread: int = 0  # jumps of measured commands that were taken out, for both models
    # runs that a model cannot simulate, with why; nothing is known of a gain then
    failed: Mapping[str, str] = field(default_factory=dict)
    # by run, what plain and extended model say of it, with the run's own values fitted, each
    # (num_samples, num_channels) [unit of the channel]
    predicted: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)
    # half of the width of the band around the extended model by run, of the same shape; NaN in
    # channels without one
    bands: Mapping[str, Array] = field(default_factory=dict)
    # what was fitted to each run for the extended model, with its prior
    own: tuple[OwnRow, ...] = ()
    # what the study describes otherwise than the model's own, a sentence each
    differences: tuple[str, ...] = ()
    # gain by kind of run, where there are several: runs whose names differ in a number or a letter
    # at their end
    kinds: Mapping[str, Gain] = field(default_factory=dict)
    # by name of a cause, the extended model without it as the plain one; empty where nothing was
    # asked of single causes
    causes: Mapping[str, Unseen] = field(default_factory=dict)
    # runs that their study gives to be fitted, which this model was not fitted to: a first answer
    # leaves out some of many
    left_out: tuple[str, ...] = ()

    @property
    def left_out_words(self) -> str:
        """What ``left_out`` proves, in a sentence; empty where there is none."""
        if not self.left_out:
            return ""
        beyond = {row.run for row in self.outside if row.is_fact}
        kinds = "" if beyond & set(self.left_out) else ", of kinds that were fitted"
        return (
            f"{len(self.left_out)} of {len(self.runs)} runs here have use: fit, but the saved "
            f"model was not fitted to them: unseen{kinds}."
        )

    def to_dict(self) -> dict[str, Any]:
        """Content of ``judge.json``, in types that JSON has."""
        content = {
            "runs": self.runs,
            "errors": self.errors,
            "band": band_words(self.errors),
            **self._gains(),
            "kinds": {name: gain_to_dict(g) for name, g in self.kinds.items()},
            "causes": {
                name: {"errors": without.errors, **without._gains()}
                for name, without in self.causes.items()
            },
            "outside": self.outside,
            "fitted": self.own,
            "differences": self.differences,
            "left_out": self.left_out,
            "num_spikes": self.num_spikes,
            "num_misread": self.num_misread,
            "failed": self.failed,
        }
        plain: dict[str, Any] = to_plain(content)
        return plain

    def _gains(self) -> dict[str, Any]:
        gains = {name: gain_to_dict(g) for name, g in self.gains.items()}
        return {"gain": None if self.gain is None else gain_to_dict(self.gain), "gains": gains}


def gain_to_dict(gain: Gain) -> dict[str, Any]:
    """A gain with its status, in types that JSON has."""
    return {**asdict(gain), "status": gain.status}


def on_unseen(
    plain: Frozen,
    extended: Frozen,
    runs: Sequence[Run],
    channels: Sequence[Channel],
    sd: Array,
    spans: Mapping[str, Span],
    *,
    seed: int,
    use: str = "test",
    commands: Sequence[Command] = (),
    unmet: Collection[str] = (),
    half_widths: Callable[[Run, float], Array | None] = lambda *_: None,
    constants: Mapping[str, float] = MappingProxyType({}),
) -> Unseen:
    """Judge a model and its extension on runs; each at its own coordinates, which stay.

    Args:
        plain: Plain model at its own fit.
        extended: Extended model at its fit; the plain one where nothing was named.
        channels: Columns of their ``measured``.
        sd: Standard deviation of the noise, (num_channels,) [unit of the channel].
        spans: What the fitted runs covered, as ``spans_of`` returns it.
        seed: Seed of the bootstraps.
        use: What the runs are for, as the rows say it.
        commands: What is known of commands: their units.
        unmet: Parameters of facts that no fitted run has: a run with such a fact tells its own.
        half_widths: Half of the width of the band around the extended model, of a run that is so
            many times outside; None: there is none.
        constants: Best constant of the fitted runs by channel, as ``constants_of`` returns it.
    """
    constant = np.array([constants.get(c.name, np.nan) for c in channels])
    errors: list[ErrorRow] = []
    failed: dict[str, str] = {}
    predicted: dict[str, tuple[Array, Array]] = {}
    bands: dict[str, Array] = {}
    cleaned, before, after, num_spikes, num_misread = [], [], [], 0, 0
    fitted: list[OwnRow] = []
    for given in runs:
        try:
            run, misread = choose_commands(given, commands, partial(_left_by, extended), sd)
            run, count = _without_spikes((plain, extended), run, sd)
            points = [
                At(replace(frozen.problem, runs=(run,)), held_out_point(frozen, run, unmet)[0])
                for frozen in (plain, extended)
            ]
            records = [point.problem.record(point.x) for point in points]
            whitened = [
                p.problem.residual_of(record) for p, record in zip(points, records, strict=True)
            ]
        except DiffsimError as error:  # of one run: the answer to all others stands
            failed[given.name] = str(error)
            continue
        num_spikes, num_misread = num_spikes + count, num_misread + misread
        said = (records[0].reshape(run.measured.shape), records[1].reshape(run.measured.shape))
        left = [run.measured - prediction for prediction in said]
        # what the study declares unknown of a run, and start states that a model fits away
        own = own_names(extended.problem.names, run, unmet)
        fitted += own_rows(points[1].problem, points[1].x, run, own)
        num_own = len(own)
        if callable(inside := getattr(extended.problem.model, "num_fitted_inside", None)):
            num_own += int(inside(run))
        # by what is predicted: a band that asks what was measured would excuse itself
        unseen = replace(run, measured=np.where(np.isfinite(run.measured), said[1], np.nan))
        far = times_outside(outside_rows([unseen], channels, spans, commands))
        if (half := half_widths(run, far)) is not None:
            bands[run.name] = half
        valid = np.isfinite(run.measured)
        first = run.measured[valid.argmax(axis=0), np.arange(valid.shape[1])]
        left += [
            run.measured - constant,
            run.measured - np.where(valid.any(axis=0), first, np.nan),
            run.measured - _predict_without(points[1], run, own),
        ]
        errors += _error_rows(run, left, half, channels, sd, num_own, use)
        predicted[run.name] = said
        before.append(whitened[0])
        after.append(whitened[1])
        cleaned.append(run)
    near = (0.0, "")
    gains = {
        run.name: replace(
            compared([run], plain, [b], [a], seed=seed),
            farthest=max((r.farthest for r in fitted if r.run == run.name), default=near),
        )
        for run, b, a in zip(cleaned, before, after, strict=True)
    }
    kinds: dict[str, list[int]] = {}
    for k, run in enumerate(cleaned):
        kinds.setdefault(OF_ONE_RUN.sub("", run.name), []).append(k)
    gain = None  # without the runs that fail it would be one over chosen runs
    if cleaned and not failed:
        whole = compared(cleaned, plain, before, after, seed=seed)
        gain = replace(whole, farthest=max((row.farthest for row in fitted), default=near))
    return Unseen(
        runs=tuple(run.name for run in runs),
        errors=tuple(errors),
        gain=gain,
        gains=gains,
        kinds={
            kind: compared(
                [cleaned[k] for k in which],
                plain,
                [before[k] for k in which],
                [after[k] for k in which],
                seed=seed,
            )
            for kind, which in kinds.items()
            if 1 < len(kinds) < len(cleaned)
        },
        outside=outside_rows(cleaned, channels, spans, commands),
        num_spikes=num_spikes,
        num_misread=num_misread,
        failed=failed,
        predicted=predicted,
        bands=bands,
        own=tuple(fitted),
    )


@dataclass(frozen=True, eq=False)
class At:
    """A problem at a point that is not fitted any more."""

    problem: Any
    x: Array


def _predict_run(frozen: Frozen, run: Run) -> Array:
    """What a model says of a run, (num_samples, num_channels) [unit of the channel]."""
    with torch.no_grad():
        return np.asarray(frozen.problem.predict(run, torch.from_numpy(frozen.x)).numpy())


def _predict_without(at: At, run: Run, own: Collection[str]) -> Array:
    """What a model says of a run whose own values are where its study states them; NaN where that
    cannot be simulated, or it has none."""
    names = at.problem.names
    x = np.where([name in own for name in names], 0.0, at.x)
    if not own:
        return np.full(run.measured.shape, np.nan)
    try:
        return _predict_run(At(at.problem, x), run)
    except DiffsimError:
        return np.full(run.measured.shape, np.nan)


def _left_by(model: Frozen, run: Run) -> Array:
    return run.measured - _predict_run(model, run)


def _without_spikes(models: Sequence[Frozen], run: Run, sd: Array) -> tuple[Run, int]:
    """The run without isolated spikes: those that every model leaves, and none makes."""
    is_spike = np.isfinite(run.measured)
    for frozen in models:
        predicted = _predict_run(frozen, run)
        left = run.measured - predicted
        (cleaned,), _ = without_spikes([run], [left], sd)
        is_spike &= ~np.isfinite(cleaned.measured)
        near = np.pad(predicted, ((2, 2), (0, 0)), constant_values=np.inf)  # no line at the ends
        lines = 0.5 * np.stack([near[1:-3] + near[3:-1], near[:-4] + near[4:]])
        own = np.abs(predicted - lines).max(axis=0)
        is_spike &= own < OWN_SPIKE_SHARE * np.abs(left)
    count = int(is_spike.sum())
    measured = np.where(is_spike, np.nan, run.measured)
    return (replace(run, measured=measured), count) if count else (run, 0)


def _error_rows(
    run: Run,
    left: Sequence[Array],
    half: Array | None,
    channels: Sequence[Channel],
    sd: Array,
    num_fitted: int,
    use: str,
) -> list[ErrorRow]:
    """One row by kind and unit of the channels.

    ``left``: what is left by the plain and the extended model, a constant, the first reading held,
    and the extended model without what was fitted to the run.
    """
    members: dict[tuple[str, str], list[int]] = {}
    for c, channel in enumerate(channels):
        members.setdefault((channel.kind, channel.shown_unit or channel.unit), []).append(c)
    rows, seen = [], run.measured
    noises = np.broadcast_to(sd, seen.shape)
    halves = np.full_like(seen, np.nan) if half is None else half
    for (kind, unit), own in members.items():
        valid = np.isfinite(seen[:, own])
        count = int(valid.sum())
        if not count:
            continue
        before, after, constant, held, bare, noise, band = (
            _rms(np.stack([shown_change(channels[c], seen[:, c], x[:, c]) for c in own], 1)[valid])
            for x in (*left, noises, halves)
        )
        row = ErrorRow(run.name, kind, unit, before, after, noise, count, num_fitted, use)
        row = replace(
            row,
            constant=constant if np.isfinite(constant) else None,
            held=held if len(run.time_s) >= MIN_SAMPLES else None,
            without=bare if num_fitted and np.isfinite(bare) else None,
        )
        if np.isfinite(wide := halves[:, own][valid]).all():
            inside = int((np.abs(left[1][:, own][valid]) <= wide).sum())
            row = replace(row, band=band, num_inside=inside)
        rows.append(row)
    return rows


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
