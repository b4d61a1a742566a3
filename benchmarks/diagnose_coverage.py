"""Do sizes that are fitted to disjoint parts of a study agree within their 90 % intervals?

``python -m benchmarks.diagnose_coverage [A,B ...] [--campaigns STUDY,STUDY] [--out FILE.md]``

Every published data set, or those that are named, by one rule: its runs but those for a test are
dealt to two parts in turn, by commands where there are two for each part, else by runs. The
extended model of a first answer is fitted to either part, with intervals as a diagnosis states
them. Two sizes agree where they differ by no more than both half-widths in quadrature; 90 % of
pairs should. A set that cannot be cut is named with the reason. Campaigns, which are studies of
one rig, stand apart: each is a part.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np

from benchmarks.diagnose_published import NAMES, library_answer
from diffsim.cli.arguments import add_executor, names
from diffsim.cli.diagnose_inputs import inputs_of, read_study
from diffsim.core import interruptible, open_executor, run_each
from diffsim.core.errors import DiffsimError
from diffsim.core.files import write_text_atomic
from diffsim.data.study import TIMELESS, Study
from diffsim.diagnose.inputs import Inputs
from diffsim.diagnose.judge.averaging import MODEL_FORM, widening
from diffsim.diagnose.judge.records import HALF_LEVEL
from diffsim.diagnose.refit import fit_null, refit
from diffsim.identify import Fit
from diffsim.identify.effect import effect_coordinates

COLUMNS = (
    "data set",
    "cut by",
    "pairs that agree",
    "of named causes",
    "by noise alone",
    "farthest apart",
    "CPU s",
)
HEAD = f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|"


@dataclass(frozen=True)
class Size:
    """A size that was fitted to one part.

    Attributes:
        part: Name of the part.
        name: Component of an effect, or base parameter.
        unit: Unit of the value.
        value: Fitted value.
        half: Half-width of its 90 % interval.
        noise_only: The same without the widening.
        is_cause: Whether it is of a cause; else of a data sheet.
    """

    part: str
    name: str
    unit: str
    value: float
    half: float
    noise_only: float
    is_cause: bool


@dataclass(frozen=True)
class Pair:
    """The same size from two parts; ``agrees`` within intervals, ``narrow`` without widening."""

    first: Size
    second: Size

    @property
    def agrees(self) -> bool:
        """Whether they differ by no more than both half-widths in quadrature."""
        return self._apart() <= float(np.hypot(self.first.half, self.second.half))

    @property
    def times_apart(self) -> float:
        """Difference over both half-widths in quadrature."""
        return self._apart() / max(float(np.hypot(self.first.half, self.second.half)), 1e-300)

    @property
    def agrees_unwidened(self) -> bool:
        """The same with the intervals that noise alone would make."""
        return self._apart() <= float(np.hypot(self.first.noise_only, self.second.noise_only))

    def _apart(self) -> float:
        return abs(self.first.value - self.second.value)


@dataclass(frozen=True)
class Outcome:
    """What became of a data set."""

    name: str  # name of the set, or of the campaigns
    cut: str  # how it was cut, or why it could not be
    pairs: tuple[Pair, ...] = ()  # sizes that both parts ask for
    cpu_s: float = 0.0  # CPU seconds of the answer and the fits

    @property
    def row(self) -> str:
        """A row of the table."""
        if not self.pairs:
            return f"| {self.name} | {self.cut} | – | – | – | – | {self.cpu_s:.0f} |"
        causes = [p for p in self.pairs if p.first.is_cause]
        named = f"{sum(p.agrees for p in causes)} of {len(causes)}" if causes else "none named"
        agree, alone = (sum(getattr(p, n) for p in self.pairs) for n in _JUDGED)
        worst = max(self.pairs, key=lambda p: p.times_apart)
        ends = " against ".join(
            f"{s.value:.4g} ± {s.half:.2g}" for s in (worst.first, worst.second)
        )
        unit = "" if worst.first.unit in ("-", "") else f" {worst.first.unit}"
        return (
            f"| {self.name} | {self.cut} | {agree} of {len(self.pairs)} | {named} "
            f"| {alone} of {len(self.pairs)} | {worst.first.name}: {ends}{unit} "
            f"| {self.cpu_s:.0f} |"
        )


_JUDGED = ("agrees", "agrees_unwidened")


def parts_of(study: Study, count: int = 2) -> tuple[str, tuple[Study, ...]]:
    """Disjoint parts of all runs but those for a test, and by what they were cut.

    Commands are dealt in turn; runs where there are too few commands. Runs without time, such as
    points of a camera's calibration, are no recording of their own: every part has them.

    Raises:
        ValueError: too few runs; the message says how many there are.
    """
    runs = [replace(r, use="fit") for r in (*study.fit_runs, *study.select_runs)]
    shared = [r for r in runs if r.setup.get(TIMELESS)]
    cut = [r for r in runs if not r.setup.get(TIMELESS)]
    groups = list(dict.fromkeys(run.group for run in cut))
    by_group = len(groups) >= 2 * count
    keys = groups if by_group else [run.name for run in cut]
    if len(keys) < count:
        raise ValueError(f"{len(keys)} run, and a later part of a run has no start of its own")
    parts = []
    for k in range(count):
        own = set(keys[k::count])
        kept = [r for r in cut if (r.group if by_group else r.name) in own]
        parts.append(replace(study, runs=(*shared, *kept)))
    return f"{len(keys)} {'commands' if by_group else 'runs'}", tuple(parts)


def sizes_of(part: str, inputs: Inputs, chosen: Chosen) -> Iterator[Size]:
    """Sizes and base parameters that one part determines."""
    null = fit_null(inputs)
    effects = [e for e in inputs.setup.effects if e.name in chosen.effects]
    found = refit(null, effects, inputs, chosen.values)
    wider = widening(found)
    units = {c: e.unit for e in effects for c in effect_coordinates([e])}
    causes = set(units)
    units |= {p.name: p.unit for p in inputs.setup.model.base if "@" not in p.name}
    for name, unit in units.items():
        if name in found.undetermined or name in found.at_bound or "@" in name:
            continue
        factor = wider.factors.get(name, wider.usual)
        yield _size(part, found, name, unit, factor, name in causes)


def _size(part: str, found: Fit, name: str, unit: str, factor: float, is_cause: bool) -> Size:
    value, sd = found.values[name], found.sd[name]
    form = MODEL_FORM * value
    half = HALF_LEVEL * float(np.hypot(factor * sd, form))
    return Size(part, name, unit, value, half, HALF_LEVEL * float(np.hypot(sd, form)), is_cause)


@dataclass(frozen=True)
class Chosen:
    """Effects that are fitted to every part, and values to start from."""

    effects: Sequence[str]
    values: Mapping[str, float] = field(default_factory=dict)


def chosen_by(inputs: Inputs) -> Chosen:
    """What the extended model of a first answer to all runs holds; a fit to a part starts there."""
    report = library_answer(inputs)
    return Chosen([e.name for e in report.best.problem.effects], report.best.values)


def compared(name: str, cut: str, parts: Sequence[Study], chosen: Chosen) -> Outcome:
    """The same effects fitted to every part, size by size."""
    sizes = [
        size
        for k, part in enumerate(parts)
        for size in sizes_of(f"{part.name} {k}", inputs_of(part, seed=0, budget="quick"), chosen)
    ]
    pairs = [Pair(a, b) for a, b in combinations(sizes, 2) if a.name == b.name and a.part != b.part]
    return Outcome(name, cut if pairs else f"{cut}; no size is told by both parts", tuple(pairs))


def outcome_of(name: str, effects: Sequence[str] = ()) -> Outcome:
    """A data set from its YAML to the agreement of its parts.

    Args:
        name: File, folder or published name.
        effects: Effects to fit; none: those of a first answer.
    """
    start = time.process_time()
    try:
        study = read_study(name)
        if study.faults is not None:
            raise ValueError("its groups have faults that differ")
        cut, parts = parts_of(study)
        whole = inputs_of(study, seed=0, budget="quick")
        found = compared(name, cut, parts, Chosen(effects) if effects else chosen_by(whole))
    except (DiffsimError, ValueError, FileNotFoundError) as error:
        found = Outcome(name, f"left out: {' '.join(str(error).split())}")
    return replace(found, cpu_s=time.process_time() - start)


def outcome_of_campaigns(names: Sequence[str], effects: Sequence[str] = ()) -> Outcome:
    """Studies of one rig, all runs but those for a test of each; arguments as of ``outcome_of``."""
    start = time.process_time()
    studies = [read_study(name) for name in names]
    whole = inputs_of(studies[0], seed=0, budget="quick")
    chosen = Chosen(effects) if effects else chosen_by(whole)
    found = compared(" against ".join(names), "campaigns", studies, chosen)
    return replace(found, cpu_s=time.process_time() - start)


def total_of(outcomes: Sequence[Outcome]) -> str:
    """Share of all pairs that agree, in a sentence."""
    pairs = [p for outcome in outcomes for p in outcome.pairs]
    if not pairs:
        return "No size was told by two parts."
    shares = [sum(getattr(p, n) for p in pairs) for n in _JUDGED]
    count = sum(bool(o.pairs) for o in outcomes)
    return (
        f"{shares[0]} of {len(pairs)} pairs of {count} data sets agree within their 90 % intervals "
        f"({shares[0] / len(pairs):.0%}); {shares[1]} would by the noise alone."
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table row by row, and the share that agrees."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("studies", nargs="*", metavar="STUDY", default=NAMES)
    parser.add_argument(
        "--effects", type=names, default=(), help="default: what a first answer has"
    )
    parser.add_argument("--campaigns", type=names, default=(), help="studies of one rig")
    parser.add_argument("--out", type=Path, help="Markdown file that gets the table, too")
    add_executor(parser, "data sets")
    args = parser.parse_args(arguments)
    lines = [HEAD]
    print(HEAD)

    def keep(_: int, outcome: Outcome) -> None:
        lines.append(outcome.row)
        print(outcome.row, flush=True)

    if args.campaigns:
        made = [outcome_of_campaigns(args.campaigns, args.effects)]
        keep(0, made[0])
    else:
        with open_executor(args.executor) as executor:
            one = partial(outcome_of, effects=args.effects)
            made = run_each(one, args.studies, executor, done=keep)
    print(f"\n{total_of(made)}")
    if args.out is not None:
        write_text_atomic(args.out, "\n".join([*lines, "", total_of(made)]) + "\n")


if __name__ == "__main__":
    with interruptible():
        main()
