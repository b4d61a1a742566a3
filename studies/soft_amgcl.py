"""Multigrid for the tangent: this project's beside AMGCL's, on the same matrices.

python -m studies.soft_amgcl --amgcl FOLDER      a clone of github.com/ddemidov/amgcl

The cantilever of thesis 4.1.5, twisted by 10 degrees, a time step of 10 ms: inertia and tangent of
one Newton iteration, assembled from products with the tangent. ``soft_amgcl.cpp`` is compiled with
GCC for AVX2, solves each to 1e-6 with one thread, and prints CPU milliseconds.
"""

from __future__ import annotations

import argparse
import itertools
import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.soft_scenes import LENGTH, cantilever, twisted
from diffsim import soft

HERE = Path(__file__).resolve().parent
DEGREES = 10.0
# Nodes that many cells apart share no element: one product finds the columns of all of them.
APART = 3
HEAD = "| | prepare, ms | solve, ms | iterations | residual |\n|---|---:|---:|---:|---:|"


def neighbors(cell: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Rows of the pattern of hexahedra in a box, from nodes' places (num_nodes, 3) [cells]."""
    sizes = cell.max(axis=0) + 1
    node = np.full(sizes, -1)
    node[tuple(cell.T)] = np.arange(len(cell))
    found = np.full((len(cell), 27), len(cell))
    for k, shift in enumerate(itertools.product((-1, 0, 1), repeat=3)):
        place = cell + np.array(shift)
        inside = ((place >= 0) & (place < sizes)).all(axis=1)
        found[inside, k] = node[tuple(place[inside].T)]
    found.sort(axis=1)
    start = np.concatenate([[0], np.cumsum((found < len(cell)).sum(axis=1))])
    return start, found[found < len(cell)].astype(np.int32)


def write_tangent(body: soft.SoftBody, width: float, path: Path) -> None:
    """The tangent of a box of hexahedra, ``width`` [m] each, for ``soft_amgcl.cpp``."""
    x = twisted(body, DEGREES).clone().requires_grad_()
    force = body.elastic_force(x)
    rest = body.x_rest.numpy()
    cell = np.rint((rest - rest.min(axis=0)) / width).astype(np.int64)
    start, column = neighbors(cell)
    row = np.repeat(np.arange(len(cell)), np.diff(start))
    color = (cell % APART) @ np.array([1, APART, APART**2])
    blocks = np.zeros((len(column), 3, 3))
    for k, axis in itertools.product(range(APART**3), range(3)):
        direction = torch.zeros_like(x)
        direction[torch.from_numpy(color == k), axis] = 1.0
        (product,) = torch.autograd.grad(force, x, direction, retain_graph=True)
        mine = color[column] == k
        blocks[mine, :, axis] = -product.numpy()[row[mine]]
    inertia = body.physics().mass.numpy() / body.dt**2
    parts = (
        np.array([len(cell), len(column)]),
        start,
        column,
        blocks,
        inertia,
        body.fixed.numpy().astype(np.uint8),
        x.detach().numpy(),
    )
    path.write_bytes(b"".join(np.ascontiguousarray(part).tobytes() for part in parts))


def compiled(amgcl: Path, eigen: Path, folder: Path) -> Path:
    """The program that solves."""
    program, sources = folder / "soft_amgcl", HERE.parent / "csrc"
    linalg = sorted(str(path) for path in (sources / "kernels/linalg").glob("*.cpp"))
    flags = ["-std=c++20", "-O3", "-march=x86-64-v3", "-w", "-DAMGCL_NO_BOOST"]
    include = [f"-I{folder}" for folder in (amgcl, sources, eigen)]
    own = str(HERE / "soft_amgcl.cpp")
    subprocess.run(["g++", *flags, *include, own, *linalg, "-o", str(program)], check=True)
    return program


def main() -> None:
    """Print a table for every size."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--amgcl", type=Path, required=True, help="a clone of AMGCL")
    parser.add_argument("--eigen", type=Path, default=Path("/usr/include/eigen3"))
    parser.add_argument("--cells", type=int, nargs="+", default=[8, 16], help="across the beam")
    args = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program = compiled(args.amgcl, args.eigen, folder)
        for cells in args.cells:
            body = cantilever("hex", (4 * cells, cells, cells))
            write_tangent(body, LENGTH / (4 * cells), folder / "tangent")
            print(f"\n{3 * body.mesh.num_nodes:,} DoF\n\n{HEAD}", flush=True)
            environment = {**os.environ, "OMP_NUM_THREADS": "1"}
            subprocess.run([str(program), str(folder / "tangent")], check=True, env=environment)


if __name__ == "__main__":
    main()
