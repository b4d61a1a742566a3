"""Does the band for unseen runs hold what it promises, told by few parts or many?

``python -m benchmarks.diagnose_band [A,B ...]``

Every published data set, or those that are named: of the parts of a first answer that were not
fitted (left out one after the other, or with use: select), 1, 2, 3, ... tell the band, and the
share of the readings of the other parts inside it is taken. No test run is looked at. Below the
means over the sets, with Student's quantile and without.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from benchmarks.diagnose_published import NAMES
from diffsim.cli.diagnose_inputs import inputs_of, read_study
from diffsim.core import interruptible
from diffsim.core.errors import DiffsimError
from diffsim.diagnose import diagnose
from diffsim.diagnose.judge.band import MORE_FREEDOM, factor_of, unfitted_parts
from diffsim.diagnose.judge.records import LEVEL

Array = NDArray[np.float64]
COUNTS = (1, 2, 3, 4, 5, 7)
MOST_CHOICES = 40  # of parts that tell the band
HEAD = f"| data set | parts | {' | '.join(f'told by {k}' for k in COUNTS)} |"
FREEDOMS = (0, MORE_FREEDOM, 3, None)  # beside the number of parts; None: the normal quantile


def student(count: int, more: int | None) -> float:
    """Student's quantile over the normal one for a number of parts."""
    if more is None:
        return 1.0
    p = 0.5 * (1.0 + LEVEL)
    return float(special.stdtrit(count + more, p) / special.ndtri(p))


def parts_of(name: str) -> tuple[list[Array], Array]:
    """Parts of a data set that its first answer was not fitted to, and the noise.

    Raises:
        ValueError: groups with faults, which have an answer each.
    """
    study = read_study(name)
    if study.faults is not None:
        raise ValueError("its groups have faults that differ")
    inputs = inputs_of(study, seed=0, budget="quick")
    setup = inputs.setup
    report = diagnose(
        inputs.study.without_tests(),
        setup.model,
        setup.effects,
        seed=inputs.seed,
        unknowns=setup.unknowns,
        settings=setup.settings,
    )
    return unfitted_parts(report.best, report.study.select_runs), report.floor.sd


def shares(parts: Sequence[Array], noise: Array, count: int, more: int | None) -> Iterator[float]:
    """Share inside of every other part, for choices of the parts that tell the band."""
    rng = np.random.default_rng(0)
    choices = list(combinations(range(len(parts)), count))
    picked = rng.permutation(len(choices))[:MOST_CHOICES]
    for chosen in (choices[i] for i in picked):
        rest, factor = factor_of([parts[i] for i in chosen], noise)
        half = factor / student(count, MORE_FREEDOM) * student(count, more) * np.hypot(noise, rest)
        for k, left in enumerate(parts):
            seen = np.isfinite(left) & np.isfinite(half)
            if k not in chosen and seen.any():
                yield float(np.mean((np.abs(left) <= half)[seen]))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row per data set, then the means."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("studies", nargs="*", metavar="STUDY", default=NAMES)
    args = parser.parse_args(arguments)
    print(f"{HEAD}\n{'|---' * (len(COUNTS) + 2)}|")
    means: dict[tuple[int, int | None], list[float]] = {}
    for name in args.studies:
        try:
            parts, noise = parts_of(name)
        except (DiffsimError, ValueError, FileNotFoundError) as error:
            print(f"| {name} | left out: {' '.join(str(error).split())} |", flush=True)
            continue
        cells = []
        for count in COUNTS:
            for more in FREEDOMS if count < len(parts) else ():
                mean = float(np.mean(list(shares(parts, noise, count, more))))
                means.setdefault((count, more), []).append(mean)
            cells.append(f"{means[count, MORE_FREEDOM][-1]:.0%}" if count < len(parts) else "–")
        print(f"| {name} | {len(parts)} | {' | '.join(cells)} |", flush=True)
    for more in FREEDOMS:
        words = "no Student" if more is None else f"{more} more degrees of freedom than parts"
        cells = [f"{np.mean(means[c, more]):.0%}" if (c, more) in means else "–" for c in COUNTS]
        print(f"| mean, {words} | | {' | '.join(cells)} |")


if __name__ == "__main__":
    with interruptible():
        main()
