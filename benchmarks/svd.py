"""Time of svd3 and polar3 per matrix, forward and forward + backward apart.

python benchmarks/svd.py --num-matrices 16384 --threads 1
DIFFSIM_ISA=avx2 python benchmarks/svd.py
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.utils.benchmark import Timer

from diffsim.core import interruptible
from diffsim.core.compiled import INSTRUCTION_SET
from diffsim.linalg.svd import polar3, svd3


def inputs(num_matrices: int) -> dict[str, Tensor]:
    """Random matrices, and rotations times strains of about one percent."""
    rng = np.random.default_rng(0)
    random = rng.standard_normal((num_matrices, 3, 3))
    turned = np.linalg.qr(random)[0]
    turned *= np.sign(np.linalg.det(turned))[:, None, None]
    near_rest = turned @ (np.eye(3) + 1e-2 * rng.standard_normal((num_matrices, 3, 3)))
    return {"random": torch.from_numpy(random), "near rest": torch.from_numpy(near_rest)}


def svd_loss(F: Tensor, num_threads: int) -> Tensor:
    """A loss that feels every output of svd3."""
    U, s, V = svd3(F, num_threads=num_threads)
    return s.sum() + U.sum() + V.sum()


def report(name: str, num_matrices: int, run: Callable[[], object], seconds: float) -> None:
    timed = Timer("run()", globals={"run": run}).blocked_autorange(min_run_time=seconds)
    scale = 1e9 / num_matrices
    print(f"{name:36s} {timed.median * scale:9.1f} ns per matrix (IQR {timed.iqr * scale:.1f})")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--num-matrices", type=int, default=16384)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1.0, help="per row")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    n, threads = args.num_matrices, args.threads
    print(f"{n} matrices, {INSTRUCTION_SET}, {threads} threads")
    for kind, F in inputs(n).items():
        leaf = F.clone().requires_grad_()

        def backward_svd(leaf: Tensor = leaf) -> object:
            return torch.autograd.grad(svd_loss(leaf, threads), leaf)

        def backward_polar(leaf: Tensor = leaf) -> object:
            return torch.autograd.grad(polar3(leaf, num_threads=threads).sum(), leaf)

        rows: dict[str, Callable[[], object]] = {
            "svd3 forward": lambda F=F: svd3(F, num_threads=threads),
            "svd3 forward + backward": backward_svd,
            "polar3 forward": lambda F=F: polar3(F, num_threads=threads),
            "polar3 forward + backward": backward_polar,
            "numpy.linalg.svd": lambda F=F: np.linalg.svd(F.numpy()),
            "torch.linalg.svd": lambda F=F: torch.linalg.svd(F),
        }
        for name, run in rows.items():
            report(f"{name}, {kind}", n, run, args.seconds)


if __name__ == "__main__":
    with interruptible():
        main()
