"""Does the band for unseen runs hold what it promises, told by few parts or many?

``python -m benchmarks.diagnose_band [A,B ...]``

Every published data set, or those that are named: of the parts of a first answer that stand for
unseen runs (left out one after the other, or with use: select), 2, 3, ... tell the band, and the
share of the readings of the other parts inside it is taken. The last column is that of the test
runs, by the band that all parts tell; it chooses nothing. Below the means over the sets.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from benchmarks.diagnose_published import NAMES
from diffsim.cli.diagnose_inputs import inputs_of, read_study
from diffsim.core import interruptible
from diffsim.core.errors import DiffsimError
from diffsim.diagnose import diagnose
from diffsim.diagnose.judge.band import Part, factor_of, like_unseen, unfitted_parts
from diffsim.diagnose.judge.records import band_share

Array = NDArray[np.float64]
COUNTS = (2, 3, 4, 5, 7)
MOST_CHOICES = 40  # of parts that tell the band
HEAD = f"| data set | parts | {' | '.join(f'told by {k}' for k in COUNTS)} | test runs |"


def parts_of(name: str) -> tuple[list[Part], Array, float | None]:
    """Parts of a data set that stand for unseen runs, the noise, and the share of the readings of
    test runs inside the band; None without test runs.

    Raises:
        ValueError: groups with faults, which have an answer each.
    """
    study = read_study(name)
    if study.faults is not None:
        raise ValueError("its groups have faults that differ")
    inputs = inputs_of(study, seed=0, budget="quick")
    setup = inputs.setup
    report = diagnose(
        inputs.study,
        setup.model,
        setup.effects,
        seed=inputs.seed,
        unknowns=setup.unknowns,
        settings=setup.settings,
    )
    parts = unfitted_parts(report.best, report.study.select_runs)
    return like_unseen(parts, report.floor.sd), report.floor.sd, band_share(report.errors)


def shares(parts: Sequence[Part], noise: Array, count: int) -> Iterator[float]:
    """Share inside of every other part, for choices of the parts that tell the band."""
    rng = np.random.default_rng(0)
    choices = list(combinations(range(len(parts)), count))
    picked = rng.permutation(len(choices))[:MOST_CHOICES]
    for chosen in (choices[i] for i in picked):
        rest, factor = factor_of([parts[i] for i in chosen], noise)
        for k, part in enumerate(parts):
            scores = part.scores(noise, rest**2)
            seen = np.isfinite(scores)
            if k not in chosen and seen.any():
                yield float(np.mean(scores[seen] <= factor))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row per data set, then the means."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("studies", nargs="*", metavar="STUDY", default=NAMES)
    args = parser.parse_args(arguments)
    print(f"{HEAD}\n{'|---' * (len(COUNTS) + 3)}|")
    means: dict[int | None, list[float]] = {count: [] for count in (*COUNTS, None)}
    for name in args.studies:
        try:
            parts, noise, tested = parts_of(name)
        except (DiffsimError, ValueError, FileNotFoundError) as error:
            print(f"| {name} | left out: {' '.join(str(error).split())} |", flush=True)
            continue
        told: dict[int | None, float | None] = {
            count: float(np.mean(list(shares(parts, noise, count)))) if count < len(parts) else None
            for count in COUNTS
        }
        told[None] = tested
        for count, share in told.items():
            means[count] += [] if share is None else [share]
        print(f"| {name} | {len(parts)} | {_cells(told.values())} |", flush=True)
    every = (float(np.mean(m)) if m else None for m in means.values())
    print(f"| mean | | {_cells(every)} |")


def _cells(shares: Iterable[float | None]) -> str:
    return " | ".join("–" if share is None else f"{share:.0%}" for share in shares)


if __name__ == "__main__":
    with interruptible():
        main()
