"""Writes the folders: ``python -m benchmarks.strangers --out FOLDER [--only arm,stand]``."""

from __future__ import annotations

import argparse
import shutil
from importlib import import_module
from pathlib import Path

import numpy as np

CASES = (
    "arm", "stand", "rubber", "plate", "manifold", "finger", "quadrotor", "quadrotor_thrust",
    "swing", "bounce", "ladder", "steering", "loadcell", "tanks", "billiard", "hexarotor", "boat",
    "survey",
)  # fmt: skip


def main() -> None:
    """Write recordings and descriptions, and say what is hidden."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the folders")
    parser.add_argument("--only", type=lambda text: text.split(","), default=CASES)
    parser.add_argument("--seed", type=int, default=20261122)
    args = parser.parse_args()
    for name in args.only:
        made = import_module(f"benchmarks.strangers.{name}")
        folder = args.out / name
        folder.mkdir(parents=True, exist_ok=True)
        made.make(folder, np.random.default_rng([args.seed, CASES.index(name)]))
        described = Path(__file__).with_name(f"{name}.yaml")
        if described.is_file():
            shutil.copy(described, folder / "study.yaml")
        print(f"{folder}: {made.HIDDEN}")


if __name__ == "__main__":
    main()
