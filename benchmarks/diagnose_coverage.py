"""Do sizes that are fitted to disjoint parts of a study agree within their 90 % intervals?

``python -m benchmarks.diagnose_coverage STUDY [STUDY ...] [--effects A,B] [--parts 2]``

Every STUDY is a file, a folder or the name of a published data set. Several are campaigns of one
rig: each is a part. One is cut into parts by commands, or by runs where there are too few commands.
The same effects are fitted to every part, with intervals as a diagnosis states them. Two parts
agree where they differ by no more than both half-widths in quadrature; 90 % of pairs should.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from diffsim.cli.arguments import add_executor, names
from diffsim.cli.diagnose_inputs import inputs_of, read_study
from diffsim.core import interruptible, open_executor, run_each
from diffsim.data.study import Run, Study
from diffsim.diagnose.diagnosis import diagnose
from diffsim.diagnose.inputs import Inputs
from diffsim.diagnose.judge.averaging import HALF_90, MODEL_FORM, widening
from diffsim.diagnose.refit import fit_null, refit
from diffsim.identify import Fit
from diffsim.identify.effect import effect_coordinates


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
    """

    part: str
    name: str
    unit: str
    value: float
    half: float
    noise_only: float


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
    def agrees_unwidened(self) -> bool:
        """The same with the intervals that noise alone would make."""
        return self._apart() <= float(np.hypot(self.first.noise_only, self.second.noise_only))

    def _apart(self) -> float:
        return abs(self.first.value - self.second.value)


def parts_of(study: Study, count: int) -> Iterator[tuple[str, Study]]:
    """Disjoint parts of a study's fit runs, by command; by run where commands are too few."""
    groups = list(dict.fromkeys(run.group for run in study.fit_runs))
    keys = groups if len(groups) >= 2 * count else [run.name for run in study.fit_runs]
    if len(keys) < count:
        raise ValueError(f"study {study.name} has {len(keys)} runs to fit, {count} parts need more")
    for k in range(count):
        own = set(keys[k::count])
        runs: Sequence[Run] = [r for r in study.fit_runs if r.group in own or r.name in own]
        yield f"part {k + 1}", replace(study, runs=tuple(runs))


def sizes_of(part: str, inputs: Inputs, chosen: Sequence[str], base: bool) -> Iterator[Size]:
    """Sizes that one part asks for."""
    null = fit_null(inputs)
    effects = [e for e in inputs.setup.effects if e.name in chosen]
    found = refit(null, effects, inputs, {})
    wider = widening(found)
    units = {c: e.unit for e in effects for c in effect_coordinates([e])}
    if base:
        units |= {p.name: p.unit for p in inputs.setup.model.base if "@" not in p.name}
    for name, unit in units.items():
        if name in found.undetermined or name in found.at_bound:
            continue
        yield _size(part, found, name, unit, wider.factors.get(name, wider.usual))


def _size(part: str, found: Fit, name: str, unit: str, factor: float) -> Size:
    value, sd = found.values[name], found.sd[name]
    form = MODEL_FORM * value
    half = HALF_90 * float(np.hypot(factor * sd, form))
    return Size(part, name, unit, value, half, HALF_90 * float(np.hypot(sd, form)))


def named_by(inputs: Inputs) -> tuple[str, ...]:
    """Effects that the extended model of a diagnosis of all runs holds."""
    setup = inputs.setup
    report = diagnose(
        inputs.study,
        setup.model,
        setup.effects,
        seed=inputs.seed,
        unknowns=setup.unknowns,
        settings=setup.settings,
    )
    print(report.headline)
    return tuple(e.name for e in report.best.problem.effects)


def _sizes_of_part(chosen: Sequence[str], base: bool, part: tuple[str, Study]) -> list[Size]:
    name, study = part
    return list(sizes_of(name, inputs_of(study, seed=0), chosen, base))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print every pair, and the share that agrees."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("studies", nargs="+", metavar="STUDY")
    parser.add_argument("--effects", type=names, default=(), help="default: what a diagnosis names")
    parser.add_argument("--parts", type=int, default=2, help="of one study (default: 2)")
    parser.add_argument("--base", action="store_true", help="base parameters, too")
    add_executor(parser, "parts")
    args = parser.parse_args(arguments)
    studies = [read_study(given) for given in args.studies]
    chosen = args.effects or named_by(inputs_of(studies[0], seed=0, budget="quick"))
    if len(studies) > 1:
        parts = [(study.name, study) for study in studies]
    else:
        parts = list(parts_of(studies[0], args.parts))
    with open_executor(args.executor) as executor:
        made = run_each(partial(_sizes_of_part, chosen, args.base), parts, executor)
    sizes = [size for part in made for size in part]
    pairs = [Pair(a, b) for a, b in combinations(sizes, 2) if a.name == b.name and a.part != b.part]
    for p in pairs:
        ends = " against ".join(f"{s.value:.4g} +- {s.half:.2g}" for s in (p.first, p.second))
        said = "agree" if p.agrees else "DIFFER"
        print(f"{p.first.name:<32} {said:<7} {ends} {p.first.unit}")
    if pairs:
        within = np.mean([p.agrees for p in pairs])
        before = np.mean([p.agrees_unwidened for p in pairs])
        print(
            f"{len(pairs)} pairs: {within:.0%} agree within their 90 % intervals; "
            f"{before:.0%} would without the widening"
        )


if __name__ == "__main__":
    with interruptible():
        main()
