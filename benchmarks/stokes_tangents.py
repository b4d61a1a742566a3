"""What forward mode of a Stokes flow costs beside the flow and its adjoint, in CPU seconds.

python -m benchmarks.stokes_tangents                  # half a minute
python -m benchmarks.stokes_tangents --cells 32 48

A round pipe that bends through n x n x n/2 cells, walls without slip; the direction is the radius.
The three are measured in turn and medians are printed; every flow has a geometry of its own.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Sequence

import torch
from torch.func import jvp

from benchmarks.harness import timed
from benchmarks.stokes_worker import bent_pipe
from diffsim.core import interruptible
from diffsim.stokes import Inlet, Open, StokesFlow


def measure(cells: int, repetitions: int) -> dict[str, float]:
    """CPU seconds of a flow, of its adjoint and of one tangent; and how well the two agree."""
    grid, level = bent_pipe(cells)
    flow = StokesFlow(grid, [Inlet("x-"), Open("x+")])
    speed = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)

    def loss(radius: torch.Tensor) -> torch.Tensor:
        return flow(level(radius), speed).velocity.square().mean()

    times: dict[str, list[float]] = {"flow": [], "adjoint": [], "tangent": []}
    gap = 0.0
    for k in range(repetitions + 1):
        radius = torch.tensor(0.18 + 1e-4 * k, dtype=torch.float64, requires_grad=True)
        value, forward = timed(lambda r=radius: loss(r))
        gradient, backward = timed(lambda v=value, r=radius: torch.autograd.grad(v, r)[0])
        at = radius.detach()
        _, prepared = timed(lambda r=at: loss(r))  # the factor is there: what jvp repeats
        (_, slope), tangent = timed(lambda r=at: jvp(loss, (r,), (torch.ones_like(r),)))
        gap = max(gap, abs(float(slope - gradient)) / abs(float(gradient)))
        if k:  # the first loads what it needs
            times["flow"].append(forward.cpu)
            times["adjoint"].append(backward.cpu)
            times["tangent"].append(tangent.cpu - prepared.cpu)
    return {name: statistics.median(row) for name, row in times.items()} | {"gap": gap}


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cells", nargs="+", type=int, default=[16, 24, 32], help="along x")
    parser.add_argument("--repetitions", type=int, default=3)
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    print("| cells | flow, CPU s | adjoint | tangent | tangent - adjoint, relative |")
    print("|---|---:|---:|---:|---:|")
    for cells in args.cells:
        found = measure(cells, args.repetitions)
        print(
            f"| {cells} x {cells} x {cells // 2} | {found['flow']:.3f} | {found['adjoint']:.3f} "
            f"| {found['tangent']:.3f} | {found['gap']:.0e} |",
            flush=True,
        )


if __name__ == "__main__":
    with interruptible():
        main()
