"""What a stiffer region costs: the cantilever with a middle third 10 and 100 times stiffer.

python -m studies.soft_contrast                  8,019 DoF, 25 steps
python -m studies.soft_contrast --cells 16 4 4 --steps 5

Even and layered beams take turns in one process; printed are CPU seconds of the whole rollout,
medians, with the ratio to the even beam, and mean iterations.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Sequence
from dataclasses import replace

import torch

from benchmarks.harness import cores
from benchmarks.soft_cantilever import options
from benchmarks.soft_scenes import LENGTH, MATERIAL, Pass, cantilever, one_pass
from diffsim import soft

CONTRASTS = (1.0, 10.0, 100.0)
PRECONDITIONERS = ("multigrid", "constant")
PHASES = ("forward", "backward")


def layered(cells: Sequence[int], contrast: float, kind: str = "hex") -> soft.SoftBody:
    """The cantilever, its middle third ``contrast`` times stiffer."""
    even = cantilever(kind, cells)
    center = even.x_rest[even.mesh.elements].mean(1)[:, 0]
    middle = (center > LENGTH / 3) & (center < 2 * LENGTH / 3)
    modulus = MATERIAL["youngs_modulus"]
    per_element = torch.where(middle, contrast * modulus, modulus).double()
    return cantilever(kind, cells, youngs_modulus=per_element)


def measure(
    cells: Sequence[int], kind: str, num_steps: int, degrees: float, repetitions: int
) -> dict[tuple[str, float], list[Pass]]:
    """Passes by preconditioner and contrast, all taking turns."""
    bodies = {}
    for name in PRECONDITIONERS:
        for contrast in CONTRASTS:
            body = layered(cells, contrast, kind)
            body.solver = replace(options("newton_pcg", 1e-4), preconditioner=name)
            one_pass(body, 1, degrees=1.0)  # not counted: prepares the system
            bodies[name, contrast] = body
    found: dict[tuple[str, float], list[Pass]] = {key: [] for key in bodies}
    for _ in range(repetitions):
        for key, body in bodies.items():
            found[key].append(one_pass(body, num_steps, degrees=degrees))
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, nargs=3, default=(32, 8, 8))
    parser.add_argument("--kind", choices=("hex", "tet"), default="hex")
    parser.add_argument("--steps", type=int, default=25)
    parser.add_argument("--degrees", type=float, default=90.0)
    parser.add_argument("--repetitions", type=int, default=3)
    args = parser.parse_args()
    torch.set_num_threads(1)
    with cores(1):
        found = measure(args.cells, args.kind, args.steps, args.degrees, args.repetitions)
    print(
        "| preconditioner | stiffer by | forward [CPU s] | backward [CPU s] | Newton, CG, adjoint |"
    )
    print("|---|---:|---:|---:|---|")
    for name in PRECONDITIONERS:
        even = None
        for contrast in CONTRASTS:
            runs = found[name, contrast]
            times = [statistics.median(getattr(r, p).cpu for r in runs) for p in PHASES]
            even = even or times
            shown = " | ".join(f"{t:.2f} ({t / e:.2f})" for t, e in zip(times, even, strict=True))
            counts = runs[0].counts()
            names = ("step_iters", "step_solves", "adjoint_iters")
            iters = ", ".join(f"{counts[n]:.1f}" for n in names)
            mark = "" if all(r.converged for r in runs) else " not converged"
            print(f"| {name} | {contrast:g} | {shown} | {iters}{mark} |")


if __name__ == "__main__":
    main()
