"""``python -m studies.pull_tests``: how far pulled servos stay off, in counts of their encoder.

Two servos pull the tested ones to either side in turn and let go. A row for each tested servo with
its goal at home: mean reading of one side less that of the other, while one pulls and after it has
let go. The first half of each state is left out: it shows the way there.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffsim.core import interruptible
from diffsim.data import find_dataset

Array = NDArray[np.float64]
HOME = 2047.0  # goal of a tested servo [count]


def sides(table: NDArray[np.void]) -> dict[str, tuple[float, float]]:
    """Reading of one side less the other, while they pull and after, by tested servo [count].

    Args:
        table: Columns by name, as the files have them.
    """
    names = table.dtype.names or ()
    goals = [name for name in names if name.endswith("goal_count")]
    tested = [name.partition("_")[0] for name in goals if name.startswith("tested")]
    pullers = [name for name in goals if name.startswith("pulling")]
    relaxed = {name: _usual(table[name]) for name in pullers}
    states = np.column_stack([table[name] for name in goals])
    starts = [0, *(np.flatnonzero(np.diff(states, axis=0).any(axis=1)) + 1), len(table)]
    found: dict[tuple[str, int, str], list[float]] = defaultdict(list)
    last = ""
    for begin, end in pairwise(starts):
        # a reading beside a new goal was taken before it
        row, seen = table[begin], table[(begin + end) // 2 + 1 : end + 1]
        if not all(row[f"{name}_goal_count"] == HOME for name in tested):
            last = ""
            continue
        pulling = [name for name in pullers if row[name] != relaxed[name]]
        last = pulling[0] if pulling else last
        if last and len(seen):
            # by where it pulls to, whatever its number is
            side = int(np.sign(relaxed[last] - HOME))
            for name in tested:
                key = (name, side, "pull" if pulling else "after")
                found[key].append(float(seen[f"{name}_position_count"].mean()))
    mean = {key: float(np.mean(values)) for key, values in found.items()}
    return {
        name: (
            mean[name, 1, "pull"] - mean[name, -1, "pull"],
            mean[name, 1, "after"] - mean[name, -1, "after"],
        )
        for name in tested
    }


def _usual(values: Array) -> float:
    """The value that is there most often."""
    kinds, counts = np.unique(values, return_counts=True)
    return float(kinds[counts.argmax()])


def main(folder: Path | None = None) -> None:
    """Print the table.

    Args:
        folder: Folder of the files; None: that of the data set.
    """
    folder = folder or find_dataset("servo_bench")
    if folder is None:
        raise FileNotFoundError(
            "no folder servo_bench; set DIFFSIM_DATA to the folder that holds it"
        )
    print("| file | tested | while one pulls | after it let go |\n| --- | --- | --- | --- |")
    for path in sorted(folder.glob("pull_*.csv")):
        table = np.genfromtxt(path, delimiter=",", names=True)
        for name, (pulled, after) in sides(table).items():
            print(f"| `{path.stem}` | {name} | {pulled:.1f} | {after:.1f} |")


if __name__ == "__main__":
    with interruptible():
        main()
