"""Checks of the recordings before any physics is blamed, of repeats, and of budgets that ended.

Runs with use: select or test must be recordings of their own: a run that was cut in two proves
nothing about its other half.
"""

from __future__ import annotations

import hashlib
import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, groupby

import numpy as np
from scipy.special import chdtrc

from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.core.figures import figure
from diffsim.core.progress import say_stage
from diffsim.data.shared_rows import SHARED_BITS, STRETCH, SharedStretch, bits_of, shared_stretches
from diffsim.data.signal import scatter
from diffsim.data.study import Run, Study
from diffsim.diagnose.checks.noise import SCATTER_CHANCE, SPIKE, UNREPEATABLE
from diffsim.identify import Fit
from diffsim.identify.effort import SearchSettings
from diffsim.identify.model import SimModel
from diffsim.identify.ranges import SURE_SD

BLOCK_OF = "block_of"  # fact of ``setup``: the recording that a run is a declared block of


def require_separate(study: Study) -> None:
    """Refuse runs of different uses that share samples, unless declared as blocks of one run.

    Raises:
        ValueError: two runs share samples; the message names both.
    """
    for a, b, count in _shared_runs(study.runs, _may_share):
        raise ValueError(
            f"run {b.name} (use: {b.use}) and run {a.name} (use: {a.use}) share "
            f"{count} samples: they are one recording. Give both the same use, leave "
            f"one out, or declare them as blocks of one run with setup: "
            f"{{{BLOCK_OF}: NAME}}"
        )


def _may_share(a: Run, b: Run) -> bool:
    return a.use == b.use or _are_blocks_of_one(a, b)


def _shared_runs(
    runs: Sequence[Run], may_share: Callable[[Run, Run], bool]
) -> Iterator[tuple[Run, Run, int]]:
    """Pairs of runs with a stretch that was recorded once, and its length; runs to fit first."""
    ordered = [run for use in ("fit", "select", "test") for run in runs if run.use == use]
    longest: dict[tuple[int, int], SharedStretch] = {}
    for found in shared_stretches(
        [run.measured for run in ordered], lambda a, b: may_share(ordered[a], ordered[b])
    ):
        pair = (found.first, found.second)
        if pair not in longest or found.length > longest[pair].length:
            longest[pair] = found
    for (a, b), found in sorted(longest.items()):
        if bits_of(ordered[b].measured[found.start : found.start + found.length]) > SHARED_BITS:
            yield ordered[a], ordered[b], found.length


def alike_channels(study: Study) -> list[tuple[Run, Run, list[str]]]:
    """Pairs of runs of different uses, with the channels of which both hold a stretch that was
    recorded once, such as the height in two frames of one recording."""
    found: dict[tuple[int, int], list[str]] = {}
    runs = study.runs
    for c, channel in enumerate(study.channels):
        say_stage(f"comparing channel {channel.name} between uses")
        bits: dict[tuple[int, int], float] = {}
        for one in shared_stretches(
            [run.measured[:, [c]] for run in runs],
            lambda a, b: _may_share(runs[a], runs[b]),
            distinct=True,
        ):
            part = runs[one.second].measured[one.start : one.start + one.length, [c]]
            pair = (one.first, one.second)
            bits[pair] = bits.get(pair, 0.0) + bits_of(part)
        for pair, size in bits.items():
            if size > SHARED_BITS:
                found.setdefault(pair, []).append(channel.name)
    return [(runs[a], runs[b], names) for (a, b), names in found.items()]


def stretches_of(run: Run) -> dict[str, int]:
    """Some stretches of rows by the hash of their content, with the row where each begins.

    Which ones depends on their content alone, so that a part of a recording has those of the whole.
    """
    rows = [_key(row) if np.isfinite(row).any() else None for row in run.measured]
    out: dict[str, int] = {}
    for i in range(len(rows) - STRETCH + 1):
        stretch = rows[i : i + STRETCH]
        if None in stretch or len(set(stretch)) < STRETCH:
            continue
        digest = hashlib.sha256(b"".join(filter(None, stretch))).digest()
        if digest[0] % 8 == 0:  # one of eight, chosen by its content: any part has the same ones
            out[digest[1:7].hex()] = i
    return out


def shared_with(run: Run, known: Mapping[str, str]) -> tuple[str, int] | None:
    """The run from which most remembered stretches of this one are, and how many samples they hold;
    None if chance may explain them.

    Args:
        run: Run that should be another recording.
        known: Name of a run by the hash of its stretches.
    """
    found: dict[str, set[int]] = {}
    for key, begin in stretches_of(run).items():
        if key in known:
            found.setdefault(known[key], set()).update(range(begin, begin + STRETCH))
    if not found:
        return None
    name = max(found, key=lambda n: len(found[n]))
    bits = sum(bits_of(run.measured[part]) for part in _parts(sorted(found[name])))
    return (name, len(found[name])) if bits > SHARED_BITS else None


def _parts(rows: Sequence[int]) -> Iterator[list[int]]:
    """Rows that follow each other, together."""
    for _, part in groupby(enumerate(rows), key=lambda pair: pair[1] - pair[0]):
        yield [row for _, row in part]


def cut_in_two(study: Study) -> list[tuple[Run, Run]]:
    """Pairs of runs of different uses of which the second goes on where the first ends."""
    uses = study.fit_runs, study.select_runs, study.test_runs
    return [
        (first, second)
        for ours, theirs in combinations(uses, 2)
        for pair in (*_on_one_clock(ours, theirs), *_on_one_clock(theirs, ours))
        for first, second in [pair]
        if not _are_blocks_of_one(first, second) and _goes_on(first, second)
    ]


def _on_one_clock(first: Sequence[Run], second: Sequence[Run]) -> list[tuple[Run, Run]]:
    """Pairs of which the second begins one step of the clock after the first ends."""
    first = [run for run in first if len(run.time_s) > 2]
    if not first or not second:
        return []
    step = np.array([np.median(np.diff(run.time_s)) for run in first])[:, None]
    end = np.array([run.time_s[-1] for run in first])[:, None]
    gap = np.array([run.time_s[0] for run in second]) - end
    return [(first[i], second[k]) for i, k in np.argwhere(np.round(gap / step) == 1.0)]


def _are_blocks_of_one(a: Run, b: Run) -> bool:
    """Whether both runs are declared as blocks of one recording."""
    return BLOCK_OF in a.setup and a.setup[BLOCK_OF] == b.setup.get(BLOCK_OF)


def _key(row: Array) -> bytes:
    return np.where(np.isfinite(row), row + 0.0, np.nan).tobytes()


def _goes_on(first: Run, second: Run) -> bool:
    """Whether a run begins at the place where another ends."""
    if first.measured.shape[1] != second.measured.shape[1]:
        return False
    for values, start in zip(first.measured.T, second.measured[0], strict=True):
        usual, bends = np.abs(np.diff(values[np.isfinite(values)])), np.diff(values, n=2)
        if not (np.isfinite(bends).any() and np.isfinite(values[-1]) and np.isfinite(start)):
            continue
        if abs(start - values[-1]) > SPIKE * float(scatter(bends, 2) + np.median(usual)):
            return False
    return True


CUTS, WINDOWS = "start_states", "windows"
COARSE, SCANS, LATE, LAWS = "coarse", "scan_budget", "refit_budget", "law_budget"
CORRECTED = "corrected"  # coarse steps, by finer ones at the answer itself, where that holds
PLAIN = "plain_budget"
CONTRADICTED = "contradicted"
MUCH_LEFT = 2.0  # noise sd, root mean square, that a fit leaves
MUCH_UNSEEN = 3.0  # noise sd, root mean square, that unseen runs show
UNSIMULABLE = "laws_in_simulation"
REPEATS, REPEATED = "repeats:", "swap"
LEAST_FREEDOM = 3  # samples beyond the numbers of a model, for a law to be one


@checked(kinds_only=True)
@dataclass(frozen=True)
class GateResult:
    """One check before any physics is blamed.

    Attributes:
        name: Name of the check, such as "time_step".
        passed: Whether the check passed.
        value: Measured quantity, such as lambda.
        limit: Limit that the value is compared with.
        note: What was checked, in words.
        applies: Whether there was anything to check; what does not apply did not pass.
    """

    name: str
    passed: bool
    value: float
    limit: float
    note: str = ""
    applies: bool = True


def data_gate(study: Study) -> tuple[GateResult, ...]:
    """Clocks, shapes, commands, repeats; runs of each use are recordings of their own.

    Raises:
        ValueError: nothing can be concluded from such files: the message names run and sample.
    """
    if not study.fit_runs:
        raise ValueError(f"study {study.name} has no run with use: fit; nothing can be diagnosed")
    for run in study.runs:
        if not np.isfinite(run.measured).any():
            raise ValueError(f"run {run.name}: nothing was measured; remove the run")
    require_separate(study)
    commands = len({r.group for r in study.fit_runs})
    repeats, tests = len(study.fit_runs) - commands, len(study.test_runs)
    seen_once = "runs that neither a fit nor the choice of causes has seen"
    if not tests:
        seen_once = "no run with use: test, so no gain is known"
    others, pairs = len(study.select_runs) + tests, cut_in_two(study)
    note = "select or test runs that go on where another run ends"
    if pairs:
        first, second = pairs[0]
        note = f"run {second.name} goes on where run {first.name} ends: it tests little"
    scatter = "runs of one command" if repeats else "no repeated run: repeatability is not judged"
    count = float(len(study.mended))
    done = [GateResult("record", True, count, count, "; ".join(study.mended))] if count else []
    return (
        *done,
        GateResult("commands", commands >= 2, commands, 2, "different commands among the fit runs"),
        GateResult("held_out", tests >= 1, tests, 1, seen_once, applies=tests > 0),
        GateResult("separate_runs", not pairs, len(pairs), 0, note, applies=others > 0),
        GateResult("repeats", repeats >= 1, repeats, 1, scatter, applies=repeats > 0),
    )


def cuts_gate(model: SimModel) -> tuple[GateResult, ...]:
    """Where runs are cut because their start states stop telling; nothing where none is.

    Args:
        model: The plain model.
    """
    if not model.cuts:
        return ()
    times = ", ".join(
        f"{run} at {', '.join(figure(time, 4) for time, _ in places)} s"
        for run, places in model.cuts.items()
    )
    _, parting = next(iter(model.cuts.values()))[0]
    note = (
        f"runs were cut where start states stop telling, {times}; each piece begins with a start "
        f"of its own. In the first, {parting}"
    )
    number = sum(map(len, model.cuts.values()))
    return (GateResult(CUTS, True, number, number, note),)


def windows_gate(model: SimModel, runs: Sequence[Run]) -> tuple[GateResult, ...]:
    """Windows in which runs were fitted, where the model's own had to be short; else nothing."""
    short = model.short_windows(runs)
    if not short:
        return ()
    lengths = ", ".join(f"{run} {figure(length)} s" for run, length in short.items())
    note = (
        f"the plain model follows the record only over short windows, {lengths}; start states of "
        "these take up what acts slowly, so that refuted and not visible hold for that length only"
    )
    return (GateResult(WINDOWS, True, min(short.values()), min(short.values()), note),)


def leaves_more(fit: Fit) -> bool:
    """Whether a fit leaves more than noise does, by its sum of squares."""
    return fit.chi2 - fit.num_samples > SURE_SD * math.sqrt(2.0 * fit.num_samples)


def budget_gates(
    num_unscanned: int, num_unfitted: int, settings: SearchSettings, plain: Fit
) -> Iterator[GateResult]:
    """What budgets left out: a larger one may show more, so it is said.

    Args:
        num_unscanned: Groups of effects with kinks that were not tried over decades.
        num_unfitted: Sets that could be better and that nobody fitted.
    """
    if plain.ended == "budget":
        note = (
            f"the plain model's fit was cut short after {plain.num_evaluations} steps: its error "
            "may be smaller than said, and so may what causes remove of it"
        )
        yield GateResult(PLAIN, False, 0.0, 0.0, note, applies=False)
    if num_unscanned:
        most = f"{_steps_words(settings.scan_steps)} or {settings.scan_points} sizes"
        note = f"groups of causes not tried over decades: {most} were spent before"
        yield GateResult(SCANS, False, float(num_unscanned), 0.0, note, applies=False)
    if num_unfitted:
        steps = min(settings.scan_steps, settings.refit_steps)
        most = f"{_steps_words(steps)} or {settings.max_rounds} moves to a better set"
        note = f"{num_unfitted} rival sets were not refitted, as {most} were spent"
        yield GateResult(LATE, False, float(num_unfitted), 0.0, note, applies=False)


def _steps_words(steps: float) -> str:
    """A budget; a search that begins when all is spent, as one with a law among the causes, has 1
    for what it must do."""
    return f"{steps:,.0f} steps" if steps > 1.0 else "all steps"


def law_gate(steps: float, *, are_found: bool = False) -> GateResult:
    """Laws that nobody listed were not looked for, or not weighed, so that is said.

    Args:
        steps: The budget that most was spent of.
        are_found: Whether laws were found, which no search has weighed among causes.
    """
    what = "found, but not weighed among causes" if are_found else "not looked for"
    note = f"laws that nobody listed were {what}, as most of {steps:,.0f} steps was spent"
    return GateResult(LAWS, False, 0.0, 0.0, note, applies=False)


def few_samples_gate(freedom: int) -> GateResult:
    """Laws that nobody listed were not looked for, as so few samples tell none.

    Args:
        freedom: Samples that were fitted, less the numbers of the plain model.
    """
    note = f"no law was looked for: {freedom} more samples than numbers of the model tell none"
    return GateResult(LAWS, False, float(freedom), float(LEAST_FREEDOM), note, applies=False)


def contradiction_gate(times: Mapping[str, float]) -> tuple[GateResult, ...]:
    """A run that contradicts other fit runs which leave noise alone; none where all runs do.

    Args:
        times: Error of each run that no fit has seen, over its noise.
    """
    run = max(times, key=lambda name: times[name], default="")
    if not run or not times[run] > MUCH_UNSEEN:
        return ()
    note = (
        f"run {run} is {figure(times[run], 2)} times the noise off what the others tell, and "
        "these leave noise alone: read its record first, else something acts in it alone"
    )
    return (GateResult(CONTRADICTED, False, times[run], MUCH_UNSEEN, note),)


def unsimulable_gate(error: Exception) -> GateResult:
    """Laws that nobody listed were found and could not be weighed beside causes, so that is said.

    Args:
        error: What came of simulating them.
    """
    note = f"laws that were found left what can be simulated, so none is told: {error}"
    return GateResult(UNSIMULABLE, False, 0.0, 0.0, note)


def repeatability_gate(fit: Fit) -> list[GateResult]:
    """One check for each kind of nuisance that every run has for itself (``name@run``).

    A gain that jitters from run to run by more than was stated leaves no scatter in the channels:
    the gain of each run, a base parameter, takes it up, and the scatter is in these parameters.

    The deviation of its standardized values from their mean over a group of repeats is N(0, 1)
    after scaling, or less, as fits shrink it. Failed: the rms over all groups is above the limit of
    the channels' scatter, and so large that chance does not make it.

    Args:
        fit: Fit with the effects that the evidence asks for, so that a drift over runs that has a
            name is not scatter.
    """
    known = {run.name: run.group for run in fit.problem.runs}
    values: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for i, parameter in enumerate(fit.problem.model.base):
        stem, _, run = parameter.name.partition("@")
        if run in known:
            values[stem][known[run]].append(float(fit.x[i]))
    out = []
    for stem, groups in values.items():
        repeats = [np.array(g) for g in groups.values() if len(g) > 1]
        freedom = sum(len(g) - 1 for g in repeats)
        if not freedom:
            continue
        total = sum(float(((g - g.mean()) ** 2).sum()) for g in repeats)
        ratio = float(np.sqrt(total / freedom))
        passed = ratio <= UNREPEATABLE or float(chdtrc(freedom, total)) > SCATTER_CHANCE
        note = f"scatter of {stem} between repeats over what its prior allows"
        out.append(GateResult(f"{REPEATS}{stem}", passed, ratio, UNREPEATABLE, note))
    return out
