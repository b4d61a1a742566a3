"""Every candidate cause of every study with all digits, and what it does: no refactoring moves it.

python -m benchmarks.listed_causes --out before.txt
python -m benchmarks.listed_causes --only published rates/beam
python -m benchmarks.listed_causes --no-fingerprint
python -m benchmarks.listed_causes --list

One ``study: cause/field = value`` a line; ``diff before.txt after.txt`` shows what changed. Of each
cause also a fingerprint: by how much it changes the prediction of the first and last run to fit at
one typical size, as norm and weighted sum with twelve digits, and whether size 0 is the scene
itself. Runs are cut to as many first samples as ``STEPS`` weighted steps (``SimModel.cost``) allow;
a model that is too dear even so is listed without. Terms of laws that nobody listed have one at
every entry. Progress goes to standard error; a study that fails has a line with its error.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import warnings
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.listed_studies import Source, sources
from benchmarks.reference_numbers import THREADS
from benchmarks.reference_values import lines_of, weighted_sum
from diffsim.core import interruptible
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.identify.law import VALUE, Entry, Variable
from diffsim.identify.model import SimModel
from diffsim.identify.setup import DiagnosisSetup

STEPS = 3e6  # weighted steps of all fingerprints of a study
FEWEST = 4  # samples of a run that is cut
MOST = 40  # samples of a run whose model takes one point at a time: flights weigh too little
SHARES = (1.0, 0.7, 1.3, 0.4)  # of the typical size, by component in turn: none is as another
FIELDS = ("family", "kind", "unit", "shown_unit", "shown_times", "typical", "components", "signed",
          "smooth", "scanned", "tries", "masks", "also_looks_like", "price", "form")  # fmt: skip


def listing(study: Study, setup: DiagnosisSetup, steps: float = STEPS) -> Iterator[str]:
    """Lines of one study, without its name.

    Args:
        study: Study as its setup cuts it.
        setup: Its model and causes.
        steps: Weighted steps of all its fingerprints; 0: none.
    """
    model = setup.model
    for p in model.base:
        bounds = f"in [{p.lower!r}, {p.upper!r}], step {p.step!r}, log {p.log}, {p.of_effect}"
        yield f"base {p.name} = {p.value!r} +- {p.sd!r} {p.unit} {bounds}"
    for name, value in model.frame.items():
        yield f"frame {name} = {value!r}"
    yield f"unknowns = {[unknown.name for unknown in setup.unknowns]}"
    yield f"bank = {[run.name for run in setup.bank]}"
    yield f"settings = {setup.settings!r}"
    yield f"causes = {[effect.name for effect in setup.effects]}"
    for entry in () if setup.laws is None else setup.laws.entries:
        yield f"law entry {entry!r}"
    for variable in () if setup.laws is None else setup.laws.variables():
        yield f"law variable {variable!r}"
    shown = {effect.name: effect for effect in setup.effects}
    shown |= {u.label: u.effect for u in setup.unknowns if hasattr(u, "effect")}
    shown |= dict(_law_terms(setup))
    values = {p.name: p.value for p in model.base}
    acts = _fingerprints(study, model, len(shown), steps)
    for name, effect in shown.items():
        for field, value in _facts(effect, study, values).items():
            yield from lines_of(f"{name}/{field}", value)
        yield from lines_of(f"{name}/acts", acts(effect))


def _facts(effect: Effect, study: Study, values: Mapping[str, float]) -> Mapping[str, Any]:
    """What a cause says of itself, as tables of the answer read it."""
    words = None if effect.words is None else effect.words(effect.typical)
    located = effect.locate
    return {
        **{field: getattr(effect, field) for field in FIELDS},
        "words": words if effect.says is None else effect.says(effect.typical, values),
        "lacks": effect.needs(study),
        "shapes": {name: repr(shape) for name, shape in effect.shapes.items()},
        "course": None if located is None else {"of": located.course.name, "at": located.times},
    }


def _law_terms(setup: DiagnosisSetup) -> Iterator[tuple[str, Effect]]:
    """A linear term at every entry of laws that nobody listed, and of every kind of variable."""
    if setup.laws is None:
        return
    pairs: dict[Hashable, tuple[Entry, Variable]] = {}
    for entry, v in product(setup.laws.entries, setup.laws.variables()):
        if v.may_be_at(entry):
            pairs.setdefault(entry.words, (entry, v))
            kind = (entry.kind, v.memory, bool(v.columns), v.times is None, v.is_turn)
            pairs.setdefault(kind, (entry, v))
    for entry, v in pairs.values():
        term = setup.laws.terms(entry, v, (VALUE,), "law", 0.1 * entry.scale)
        yield f"law: {entry.words} by {v.name}", term


def _fingerprints(
    study: Study, model: SimModel, num: int, steps: float
) -> Callable[[Effect], Mapping[str, Any]]:
    """What says how a cause acts in the first and last run to fit, at the prior.

    Args:
        study: Study with the runs.
        model: Plain model.
        num: Number of causes.
        steps: Weighted steps of all of them.
    """
    at = model.at_prior()
    ends = {run.name: run for run in study.fit_runs[:: max(len(study.fit_runs) - 1, 1)]}
    share = steps / (len(ends) * (2 * num + 1))
    runs = [_cut(run, model, share) for run in ends.values()]
    if any(model.cost(run) > share for run in runs):
        return lambda effect: {"not run": f"{max(map(model.cost, runs)):.3g} steps"}
    try:
        plain = [model.predict(run, at) for run in runs]
    except ValueError as error:  # such as no reading of a slow channel among the first samples
        why = " ".join(str(error).split())
        return lambda effect: {"not run": why}

    def acts(effect: Effect) -> dict[str, Any]:
        count = len(effect.components)
        size = effect.typical * torch.tensor(SHARES, dtype=at.dtype).repeat(count)[:count]
        try:
            none = [model.predict(run, at, {effect: 0.0 * size}) for run in runs]
            full = [model.predict(run, at, {effect: size}) for run in runs]
        except Exception as error:  # what a cause raises is what it does
            return {"error": f"{type(error).__name__}: {' '.join(str(error).split())}"}
        same = all(map(_is_same, none, plain))
        change = torch.cat([(f - p).ravel() for f, p in zip(full, plain, strict=True)])
        known = torch.nan_to_num(change)
        total = weighted_sum(known)
        said = f"norm {known.norm():.12g}, weighted {total:.12g}, NaN {change.isnan().sum()}"
        return {"change": said, "nothing at 0": same}

    return acts


def _is_same(a: Tensor, b: Tensor) -> bool:
    return torch.allclose(a, b, rtol=0.0, atol=0.0, equal_nan=True)


def _cut(run: Run, model: SimModel, share: float) -> Run:
    """The first samples of a run, half of them as long as they cost more than a share."""
    run = run if model.batched else run.part(slice(MOST))
    while model.cost(run) > share and len(run.time_s) > FEWEST:
        run = run.part(slice(max(len(run.time_s) // 2, FEWEST)))
    return run


def of_source(name: str, make: Source, steps: float) -> Iterator[str]:
    """Lines of one study by its name; its error, where it has none."""
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            for line in listing(*make(), steps):
                yield f"{name}: {line}"
    except Exception as error:  # one study that a move has broken must not hide the others
        yield f"{name}: failed: {type(error).__name__}: {' '.join(str(error).split())}"


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; the exit status."""
    os.environ.update(dict.fromkeys(THREADS, "1"))
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.listed_causes",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, help="file that gets the lines; none: standard output")
    parser.add_argument("--only", nargs="+", default=[""], help="studies whose names begin so")
    parser.add_argument("--no-fingerprint", action="store_true", help="nothing is simulated")
    parser.add_argument("--list", action="store_true", help="names of the studies")
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    chosen = {n: make for n, make in sources().items() if n.startswith(tuple(args.only))}
    if args.list:
        print("\n".join(chosen))
        return 0
    with nullcontext(sys.stdout) if args.out is None else args.out.open("w") as out:
        for name, make in chosen.items():
            begin = time.process_time()
            for line in of_source(name, make, 0.0 if args.no_fingerprint else STEPS):
                print(line, file=out, flush=True)
            print(f"{name}: {time.process_time() - begin:.1f} CPU s", file=sys.stderr, flush=True)
    return 0


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
