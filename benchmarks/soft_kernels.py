"""What the kernels over elements reach of the machine's limits, on the thesis's cantilever.

    DIFFSIM_ISA=avx2 python -m benchmarks.soft_kernels
    python -m benchmarks.soft_kernels --kind tet --seconds 2
    python -m benchmarks.soft_kernels --cells 64 16 16    16,384 hexahedra: calls cost nothing

Times are CPU seconds of one thread, medians. The machine's limits are measured before and after: a
matrix product (flops) by a BLAS told to use the same instruction set, and a dot product of long
vectors (bytes from memory). Flops are counted from the kernels' source;
a division or a square root counts as one. Rates of kernels whose data fit a cache may exceed
the memory's.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from benchmarks.harness import repeat_for
from benchmarks.soft_operations import node_graph
from benchmarks.soft_scenes import cantilever, loss_weights, twisted
from diffsim.core.compiled import INSTRUCTION_SET, core
from diffsim.linalg.svd import polar3, svd3
from labs.machine import machine

# What OpenBLAS calls a processor with our instruction set.
BLAS = {"avx2": "Haswell", "avx512": "SkylakeX", "baseline": "Prescott"}
MATERIALS = ("pd", "corotated", "stable_neo_hookean", "neo_hookean", "stvk")
# Flops per sample, counted in csrc/kernels. A Jacobi turn has 58, a sweep three and a test; random
# matrices take four to five sweeps, eight at a time as many as the slowest.
SVD_FLOPS = 5 * (3 * 58 + 8) + 230
POLAR_FLOPS = 4 * 66  # Newton's steps near rest
GRADIENT_FLOPS = {"hex": 144 + 9 + 144, "tet": 72 + 9 + 60}  # F, weights, nodal forces
# A material's stress, from F, and its dP/dF: pd by singular values, projection and principal axes,
# corotated by Newton's steps to the rotation, the others in F itself.
LAW_FLOPS = {
    "pd": (SVD_FLOPS + 5 * 45 + 80, 650),
    "corotated": (POLAR_FLOPS + 75, 460),
    "stable_neo_hookean": (210, 200),
    "neo_hookean": (215, 175),
    "stvk": (125, 225),
}
ADJOINT_FLOPS = {"hex": 144 + 162, "tet": 72 + 162}  # dz/dX, dP/dF times it
PARAMETER_FLOPS = 144 + 9 + 2 * 45  # dz/dX, two stresses and their products with it


@dataclass(frozen=True)
class Row:
    """One kernel: its time [s], its flops and the bytes that it must move once."""

    name: str
    seconds: float
    flops: float = 0.0
    num_bytes: float = 0.0


def median(call: Callable[[], object], seconds: float) -> float:
    """Median CPU time of a call [s]."""
    return statistics.median(t.cpu for t in repeat_for(call, seconds=seconds))


def limits(seconds: float) -> tuple[float, float]:
    """Flops and bytes per second that this machine reaches [1/s].

    In a process of its own, since a BLAS chooses its kernels when it is loaded.
    """
    environment = {
        **os.environ,
        "OPENBLAS_CORETYPE": BLAS.get(INSTRUCTION_SET, ""),
        "OPENBLAS_NUM_THREADS": "1",
    }
    command = [sys.executable, "-m", "benchmarks.soft_kernels", "--limits", str(seconds)]
    answer = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    flops, bandwidth = answer.stdout.split()[-2:]
    return float(flops), float(bandwidth)


def measure_limits(seconds: float) -> tuple[float, float]:
    """The rates of a product of matrices in the second cache, and of reading 128 MiB."""
    a = np.random.default_rng(0).standard_normal((192, 192))
    b, out = a.T.copy(), np.empty_like(a)
    product = median(lambda: np.matmul(a, b, out=out), seconds)
    long = np.ones((2, 1 << 23))
    return 2 * 192**3 / product, long.nbytes / median(lambda: np.dot(*long), seconds)


def svd_rows(seconds: float) -> list[Row]:
    """Singular values and rotations of as many matrices near rest as the mesh has samples."""
    count = 16384
    noise = np.random.default_rng(0).standard_normal((count, 3, 3))
    F = torch.from_numpy(np.eye(3) + 1e-2 * noise)
    return [
        Row("svd3", median(lambda: svd3(F), seconds), count * SVD_FLOPS, 8 * count * 30),
        Row("polar3", median(lambda: polar3(F), seconds), count * POLAR_FLOPS, 8 * count * 18),
    ]


def material_rows(kind: str, material: str, cells: Sequence[int], seconds: float) -> list[Row]:
    """Elastic force, and its adjoint: a product with the tangent, and the parameters' gradients."""
    weight_rule = "thesis" if material == "pd" else "small_strain"
    body = cantilever(kind, cells, material=material, volume_weight=weight_rule)
    samples = body.mesh.num_elements * (8 if kind == "hex" else 1)
    x = twisted(body)
    weight, _ = loss_weights(body.mesh.num_nodes)
    with torch.no_grad():
        gradient = median(lambda: body.elastic_force(x), seconds)
    leaf = x.clone().requires_grad_()
    force = body.elastic_force(leaf)
    adjoint = median(lambda: torch.autograd.grad(force, leaf, weight, retain_graph=True), seconds)
    stress, law = LAW_FLOPS[material]
    each = GRADIENT_FLOPS[kind] + stress
    more = law + ADJOINT_FLOPS[kind] + PARAMETER_FLOPS
    return [
        Row(f"force, {material}", gradient, samples * each),
        Row(f"adjoint, {material}", adjoint, samples * (each + more)),
    ]


def solve_rows(kind: str, seconds: float) -> list[Row]:
    """Solves of three right-hand sides with the constant factor, in both precisions."""
    body = cantilever(kind)
    graph = node_graph(body.mesh)
    indptr, indices = (part.astype(np.int64) for part in (graph.indptr, graph.indices))
    values = np.ascontiguousarray(graph.data)
    b = np.random.default_rng(0).standard_normal((graph.shape[0], 3))
    z = np.empty_like(b)
    rows = []
    for name, single in (("solve, float64 factor", False), ("solve, float32 factor", True)):
        factor = core.SparseFactor(
            graph.shape[0],
            indptr.ctypes.data,
            indices.ctypes.data,
            body.mesh.x_rest.data_ptr(),
            1,
            single,
        )
        factor.refactor(values.ctypes.data, 1)

        def solve(factor: Any = factor) -> None:
            factor.solve(b.ctypes.data, z.ctypes.data, 3, 1)

        entries = factor.bytes / (4 if single else 8)
        rows.append(Row(name, median(solve, seconds), 12.0 * entries, 2.0 * factor.bytes))
    return rows


def table(rows: list[Row], flops: float, bandwidth: float) -> list[str]:
    """A Markdown table: time, rates and their shares of the limits."""
    lines = [
        "| kernel | ms | GFlop/s | of the flop limit | GB/s | of the memory's |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        rate, stream = row.flops / row.seconds, row.num_bytes / row.seconds
        moved = f"{stream / 1e9:.1f} | {stream / bandwidth:.0%}" if row.num_bytes else "– | –"
        lines.append(
            f"| {row.name} | {row.seconds * 1e3:.2f} | {rate / 1e9:.1f} | {rate / flops:.0%} "
            f"| {moved} |"
        )
    return lines


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kind", choices=("hex", "tet"), default="hex")
    parser.add_argument("--cells", type=int, nargs=3, default=(32, 8, 8), help="of the materials")
    parser.add_argument("--seconds", type=float, default=1.0, help="per row")
    parser.add_argument("--limits", type=float, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.limits is not None:
        print(*measure_limits(args.limits))
        return 0
    torch.set_num_threads(1)
    seconds = args.seconds
    before = limits(seconds)
    rows = svd_rows(seconds)
    for material in MATERIALS:
        rows += material_rows(args.kind, material, args.cells, seconds)
    rows += solve_rows(args.kind, seconds)
    after = limits(seconds)  # beside other work both move
    flops, stream = (0.5 * (a + b) for a, b in zip(before, after, strict=True))
    where = machine()
    print(f"{where['cpu']}, {where['compiler']}, {INSTRUCTION_SET}, {args.kind}, one thread")
    print(f"limits: {flops / 1e9:.1f} GFlop/s, {stream / 1e9:.1f} GB/s")
    print("\n".join(table(rows, flops, stream)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
