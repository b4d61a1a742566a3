"""What a second thread is worth: the cantilever by one and by two threads, in turn.

python -m studies.soft_threads                   8,019 to 315,900 DoF, two minutes on idle cores
python -m studies.soft_threads --width 8 16      cells across; a beam is four times as long

Printed are wall seconds a step, forward and backward, medians. Give it two idle cores.
"""

from __future__ import annotations

import argparse
import statistics

import torch

from benchmarks.harness import cores
from benchmarks.soft_cantilever import options
from benchmarks.soft_scenes import Pass, cantilever, one_pass

# Cells across: cells, steps, degrees of twist, passes of each thread count.
BEAMS: dict[int, tuple[tuple[int, int, int], int, float, int]] = {
    8: ((32, 8, 8), 25, 90.0, 5),
    16: ((64, 16, 16), 4, 10.0, 5),
    29: ((116, 29, 29), 2, 10.0, 3),
}
THREADS = (1, 2)


def measure(width: int) -> dict[int, list[Pass]]:
    """Passes by the count of threads, taking turns."""
    cells, num_steps, degrees, repetitions = BEAMS[width]
    body = cantilever("hex", cells)
    found: dict[int, list[Pass]] = {count: [] for count in THREADS}
    for repetition in range(repetitions + 1):
        for count in THREADS:
            body.solver = options("auto", 1e-4, count)
            run = one_pass(body, num_steps, degrees=degrees)
            if repetition:  # the first one prepares the body
                found[count].append(run)
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--width", type=int, nargs="+", choices=BEAMS, default=list(BEAMS))
    args = parser.parse_args()
    torch.set_num_threads(1)
    print("| DoF | one thread | two threads | ratio of the sums |")
    print("|---:|---:|---:|---:|")
    for width in args.width:
        (a, b, c), num_steps, *_ = BEAMS[width]
        with cores(max(THREADS)):
            found = measure(width)
        wall = {
            count: [
                statistics.median(phase.wall for phase in phases) / num_steps
                for phases in ([r.forward for r in runs], [r.backward for r in runs])
            ]
            for count, runs in found.items()
        }
        shown = " | ".join(", ".join(f"{t:.4f}" for t in wall[count]) for count in THREADS)
        ratio = sum(wall[1]) / sum(wall[2])
        print(f"| {3 * (a + 1) * (b + 1) * (c + 1):,} | {shown} | {ratio:.2f} |", flush=True)


if __name__ == "__main__":
    main()
