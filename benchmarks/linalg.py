"""Sparse Cholesky of hexahedral grids: analysis, factorization and solve times.

    python benchmarks/linalg.py --nodes 33x9x9 33x18x18 --threads 1 2 --json linalg.json

Times are medians (and minima) of repeated calls of the compiled core, in milliseconds. ``stream``
is the time to sum twice as many bytes as L holds with numpy, a yardstick for a solve, which reads
L twice. SuperLU (scipy) is factored once with its default ordering, for scale.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
import torch

from diffsim.core import interruptible
from diffsim.linalg._ops_cholesky import SparseFactor


def grid_matrix(shape: tuple[int, ...], block: int) -> tuple[sp.bsr_matrix, np.ndarray]:
    """Diagonally dominant matrix on the 27-point pattern of a grid, and the node coordinates."""
    axes = [sp.diags([np.ones(n - 1), np.ones(n), np.ones(n - 1)], [-1, 0, 1]) for n in shape]
    pattern = sp.kron(sp.kron(axes[0], axes[1]), axes[2])
    offdiagonal = pattern - sp.identity(pattern.shape[0])
    cell = 0.1 * np.ones((block, block)) + 0.9 * np.identity(block)
    matrix = sp.kron(-offdiagonal, cell) + (28.0 * block) * sp.identity(block * pattern.shape[0])
    matrix = matrix + sp.kron(pattern, np.full((block, block), 1e-12))  # keep every block full
    blocks = matrix.tobsr((block, block))
    blocks.sort_indices()
    coords = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    return blocks, coords.astype(np.float64)


def timed(call: Callable[[], object], seconds: float) -> dict[str, float]:
    """Median and minimum wall time and minimum CPU time of repeated calls [ms]."""
    wall, cpu = [], []
    start = time.perf_counter()
    while len(wall) < 3 or time.perf_counter() - start < seconds:
        wall_before, cpu_before = time.perf_counter(), time.process_time()
        call()
        wall.append(time.perf_counter() - wall_before)
        cpu.append(time.process_time() - cpu_before)
    return {
        "median": 1e3 * float(np.median(wall)),
        "min": 1e3 * min(wall),
        "cpu": 1e3 * min(cpu),
    }


def superlu(matrix: sp.bsr_matrix, num_rhs: int, seconds: float) -> dict[str, dict[str, float]]:
    csc = matrix.tocsc()
    b = np.ones((csc.shape[0], num_rhs))
    start = time.perf_counter()
    factor = spla.splu(csc)
    once = 1e3 * (time.perf_counter() - start)
    return {
        "factor": {"median": once, "min": once},
        "solve": timed(lambda: factor.solve(b), seconds),
    }


def measure(shape, block, precision, threads, coords_given, seconds) -> dict:
    matrix, coords = grid_matrix(shape, block)
    indptr = torch.as_tensor(matrix.indptr.astype(np.int64))
    indices = torch.as_tensor(matrix.indices.astype(np.int64))
    values = torch.as_tensor(matrix.data)
    place = torch.as_tensor(coords) if coords_given else None
    start = time.perf_counter()
    factor = SparseFactor(indptr, indices, place, block, precision == "float32")
    analysis = 1e3 * (time.perf_counter() - start)
    num_rhs = 3 if block == 1 else 1
    b = torch.linspace(-1, 1, matrix.shape[0] * num_rhs, dtype=torch.float64).reshape(-1, num_rhs)
    result = {
        "nodes": "x".join(map(str, shape)),
        "block": block,
        "precision": precision,
        "threads": threads,
        "num_rhs": num_rhs,
        "analysis": analysis,
        "factor": timed(lambda: factor.refactor(values, threads), seconds),
        "solve": timed(lambda: factor.solve(b, threads), seconds),
        "nnz": factor.nnz,
        "bytes": factor.bytes,
        "gflop": factor.flops / 1e9,
    }
    data = np.ones(factor.bytes // 8)
    result["stream"] = 2 * timed(data.sum, seconds / 4)["min"]
    residual = matrix @ factor.solve(b, threads).numpy() - b.numpy()
    result["residual"] = float(np.abs(residual).max())
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--nodes", nargs="+", default=["33x9x9", "33x18x18"])
    parser.add_argument("--block", nargs="+", type=int, default=[1, 3])
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--precision", nargs="+", default=["float64"])
    parser.add_argument("--graph", action="store_true", help="order without coordinates")
    parser.add_argument("--seconds", type=float, default=0.6, help="time per measurement")
    parser.add_argument("--superlu-max", type=int, default=11000, help="largest n for SuperLU")
    parser.add_argument("--json", help="also write the results to this file")
    args = parser.parse_args()

    print(
        f"{'nodes':>10} b {'store':>7} thr | {'nnz(L)':>8} {'MB':>6} | {'analyze':>7} |"
        f" {'factor':>8} {'min':>8} {'cpu':>8} {'GF/s':>5} |"
        f" {'solve':>7} {'min':>7} {'cpu':>7} | {'stream':>6} |  ms; residual"
    )
    results = []
    for nodes in args.nodes:
        shape = tuple(int(n) for n in nodes.split("x"))
        for block in args.block:
            for precision in args.precision:
                for threads in args.threads:
                    r = measure(shape, block, precision, threads, not args.graph, args.seconds)
                    results.append(r)
                    f, s = r["factor"], r["solve"]
                    print(
                        f"{nodes:>10} {block} {precision:>7} {threads:>3} | {r['nnz'] / 1e6:7.2f}M"
                        f" {r['bytes'] / 1e6:6.1f} | {r['analysis']:7.1f} | {f['median']:8.2f}"
                        f" {f['min']:8.2f} {f['cpu']:8.2f} {r['gflop'] / f['cpu'] * 1e3:5.0f} |"
                        f" {s['median']:7.3f} {s['min']:7.3f} {s['cpu']:7.3f} |"
                        f" {r['stream']:6.3f} |  {r['residual']:.0e}",
                        flush=True,
                    )
            matrix, _ = grid_matrix(shape, block)
            if matrix.shape[0] <= args.superlu_max:
                lu = superlu(matrix, 3 if block == 1 else 1, args.seconds)
                results.append({"nodes": nodes, "block": block, "solver": "superlu", **lu})
                print(
                    f"{nodes:>10} {block} SuperLU: factor {lu['factor']['min']:.1f} ms,"
                    f" solve {lu['solve']['min']:.2f} ms",
                    flush=True,
                )
    if args.json:
        with open(args.json, "w") as file:
            json.dump(results, file, indent=1)


if __name__ == "__main__":
    with interruptible():
        main()
