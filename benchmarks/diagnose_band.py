"""Does the band for unseen runs hold what it promises, told by few parts or many?

``python -m benchmarks.diagnose_band [A,B ...]``

Every published data set, or those that are named: of the parts that a first answer was not fitted
to (left out one after the other, or with use: select), 2, 3, ... tell the band, and the share of
the readings of the other parts inside it is taken. Then come the least and the most of a single
part, told by all others: so far do single runs of this set lie from what is promised. The last
column is the share of the test runs, by the band that all parts tell, and their number; it chooses
nothing. Below the means over the sets.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from benchmarks.diagnose_published import NAMES, library_answer
from diffsim.cli.diagnose_inputs import inputs_of, read_study
from diffsim.core import interruptible
from diffsim.core.errors import DiffsimError
from diffsim.diagnose.judge.band import Part, factor_of, noise_of, settled, unfitted_parts
from diffsim.diagnose.judge.records import band_share

Array = NDArray[np.float64]
COUNTS = (2, 3, 5)
MOST_CHOICES = 40  # of parts that tell the band
COLUMNS = ("data set", "parts", *(f"told by {k}" for k in COUNTS), "single parts", "test runs")
HEAD = f"| {' | '.join(COLUMNS)} |"


def parts_of(name: str) -> tuple[list[Part], Array, float | None, int]:
    """Parts of a data set that were not fitted, the noise that they tell, the share of the readings
    of test runs inside the band, None without test runs, and how many these are.

    Raises:
        ValueError: groups with faults, which have an answer each.
    """
    study = read_study(name)
    if study.faults is not None:
        raise ValueError("its groups have faults that differ")
    inputs = inputs_of(study, seed=0, budget="quick")
    report = library_answer(inputs)
    channels, select = report.study.channels, report.study.select_runs
    parts = unfitted_parts(report.best, channels, select, plain=report.null)
    told, tests = settled(parts), len(report.study.test_runs)
    return told, noise_of(told, report.floor.sd), band_share(report.errors), tests


def shares(parts: Sequence[Part], noise: Array, count: int) -> Iterator[float]:
    """Share inside of every other part, for choices of the parts that tell the band."""
    rng = np.random.default_rng(0)
    choices = list(combinations(range(len(parts)), count))
    picked = rng.permutation(len(choices))[:MOST_CHOICES]
    for chosen in (choices[i] for i in picked):
        told, factor = factor_of([parts[i] for i in chosen], noise)
        for k, part in enumerate(parts):
            scores = np.abs(part.left) / np.sqrt(told.variance(noise, part))
            seen = np.isfinite(scores)
            if k not in chosen and seen.any():
                yield float(np.mean(scores[seen] <= factor))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row per data set, then the means."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("studies", nargs="*", metavar="STUDY", default=NAMES)
    args = parser.parse_args(arguments)
    print(f"{HEAD}\n{'|---' * len(COLUMNS)}|")
    means: dict[int | None, list[float]] = {count: [] for count in (*COUNTS, None)}
    for name in args.studies:
        try:
            parts, noise, tested, tests = parts_of(name)
        except (DiffsimError, ValueError, FileNotFoundError) as error:
            print(f"| {name} | left out: {' '.join(str(error).split())} |", flush=True)
            continue
        told: dict[int, float | None] = {
            count: float(np.mean(list(shares(parts, noise, count)))) if count < len(parts) else None
            for count in COUNTS
        }
        for count, share in (*told.items(), (None, tested)):
            means[count] += [] if share is None else [share]
        ends = f"{_single(parts, noise)} | {_cells([tested])} of {tests}"
        print(f"| {name} | {len(parts)} | {_cells(told.values())} | {ends} |", flush=True)
    every = [float(np.mean(m)) if m else None for m in means.values()]
    print(f"| mean | | {_cells(every[:-1])} | | {_cells(every[-1:])} |")


def _single(parts: Sequence[Part], noise: Array) -> str:
    """The least and the most share of a part inside the band that all others tell."""
    if len(parts) < 3:
        return "–"
    every = list(shares(parts, noise, len(parts) - 1))
    return f"{min(every):.0%} to {max(every):.0%}"


def _cells(shares: Iterable[float | None]) -> str:
    return " | ".join("–" if share is None else f"{share:.0%}" for share in shares)


if __name__ == "__main__":
    with interruptible():
        main()
