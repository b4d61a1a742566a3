"""Value and gradient of large Stokes flows by the iterative solver: time, iterations, memory.

python -m benchmarks.stokes_large                        # 128 x 128 x 64 twister, minutes
python -m benchmarks.stokes_large --scene box --cells 32 64 --solver direct iterative
python -m benchmarks.stokes_large --scene pipe --incompressible    # 128 x 128 x 128

Scenes: "box" (no embedded wall), "twister" (slip wall, a wavy tunnel), "twister_no_slip", "funnel"
(slip walls, two cases; half as high), "pipe" (no slip, a bend in a cube). The loss is the mean
square of the velocity. Every solve runs in a process of its own, so that the peak of memory is its
own.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from benchmarks.harness import timed
from diffsim.core import interruptible
from diffsim.core.files import write_json_atomic
from diffsim.stokes import Grid, Inlet, Open, SolverOptions, StokesFlow
from diffsim.stokes.devices import funnel, twister
from diffsim.stokes.devices.device import Device, quiet
from diffsim.stokes.options import METHODS
from labs.machine import machine

SCENES = ("box", "pipe", "twister", "twister_no_slip", "funnel")
FINEST = 64  # cells of the finest level set that is evaluated; beyond, interpolated (it takes long)
FUNNEL = (0.1, 0.3, 0.3, 0.1, 0.3, 0.7, 0.6, 0.3, 0.6, 0.7)  # a design with open passages


def scene(name: str, cells: int) -> tuple[StokesFlow, Tensor, Mapping[str, Tensor]]:
    """A flow that is not yet prepared, its level set and its inlets; ``cells`` along x."""
    if name == "box":
        grid = Grid((cells, cells, cells // 2), size=(1.0, 1.0, 0.5))
        flow = StokesFlow(grid, [Inlet("x-"), Open("x+")])
        _, y, z = flow.inlet_positions().unbind(-1)
        speed = 64.0 * y * (1.0 - y) * z * (0.5 - z)
        inlet = torch.stack([speed, torch.zeros_like(speed), torch.zeros_like(speed)], dim=-1)
        return flow, torch.ones(grid.node_shape, dtype=torch.float64), {"x-": inlet}
    if name == "pipe":
        grid = Grid((cells, cells, cells), size=1.0)
        flow = StokesFlow(grid, [Inlet("x-"), Open("x+")])
        x, y, z = grid.nodes.unbind(-1)
        phi = 0.3 - torch.hypot(y - 0.5 - 0.1 * torch.sin(torch.pi * x), z - 0.5)
        return flow, phi, {"x-": torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)}
    device = _device(name, cells)
    x = torch.tensor(FUNNEL, dtype=torch.float64)
    if name != "funnel":
        generator = torch.Generator().manual_seed(0)
        x = 0.3 + 0.05 * torch.randn(32, generator=generator, dtype=torch.float64)
    phi = _device(name, min(cells, FINEST)).level_set(x)
    if cells > FINEST:
        shape = device.flow.grid.node_shape
        phi = interpolate(phi[None, None], size=shape, mode="trilinear", align_corners=True)[0, 0]
    return device.flow, phi, device.states[0].inlet


def _device(name: str, cells: int) -> Device:
    if name == "funnel":
        return funnel(cells / 64)
    return twister(cells / 64, wall="no_slip" if name == "twister_no_slip" else "no_separation")


def measure(
    name: str, cells: int, solver: str, rtol: float, threads: int, incompressible: bool
) -> dict[str, Any]:
    """Times by phase [s], iterations, residuals and memory [GB] of one value and gradient."""
    with quiet():
        (made, phi, inlet), level_set = timed(lambda: scene(name, cells))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        options = SolverOptions(method=solver, rtol=rtol, num_threads=threads, max_iters=400)
        flow = StokesFlow(
            made.grid,
            made.boundary,
            wall=made.wall,
            incompressible=incompressible,
            solver=options,
        )
        phi = phi.clone().requires_grad_()
        report, prepare = timed(lambda: flow.report(phi))
        field, forward = timed(lambda: flow(phi, inlet))
        loss = field.velocity.square().mean()
        _, backward = timed(loss.backward)
    assert phi.grad is not None
    return {
        "scene": name,
        "shape": list(flow.grid.shape),
        "solver": report["solver"],
        "rtol": rtol,
        "incompressible": incompressible,
        "threads": threads,
        "num_cells": report["num_cells"],
        "num_nodes": report["num_nodes"],
        "wall_s": {
            "level set": level_set.wall,
            "prepare": prepare.wall,
            "forward": forward.wall,
            "backward": backward.wall,
        },
        "cpu_s": {
            "level set": level_set.cpu,
            "prepare": prepare.cpu,
            "forward": forward.cpu,
            "backward": backward.cpu,
        },
        "iterations": field.stats["num_iters"].tolist(),
        "residual": field.stats["residual"].tolist(),
        "divergence": field.stats["divergence"].tolist(),
        "gradient_norm": float(phi.grad.norm()),
        "solver_GB": float(report["solver_bytes"]) / 1e9,
        "peak_GB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        "before_GB": before / 1e6,
    }


def line(found: dict[str, Any]) -> str:
    """One line of the table."""
    cpu = ", ".join(f"{name} {value:.1f}" for name, value in found["cpu_s"].items())
    return (
        f"{found['scene']:15} {'x'.join(map(str, found['shape'])):11} {found['solver']:9} "
        f"{found['num_nodes']:8} nodes  iterations {found['iterations']}  CPU s: {cpu}  "
        f"wall {sum(found['wall_s'].values()):.0f} s  peak {found['peak_GB']:.2f} GB"
    )


def main(arguments: Sequence[str] | None = None) -> list[dict[str, Any]]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scene", nargs="+", choices=SCENES, default=["twister"])
    parser.add_argument("--cells", nargs="+", type=int, default=[128], help="along x")
    parser.add_argument("--solver", nargs="+", choices=METHODS, default=["iterative"])
    parser.add_argument("--rtol", type=float, default=1e-8)
    parser.add_argument("--incompressible", action="store_true", help="div v = 0 in every cell")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, help="JSON file")
    args = parser.parse_args(arguments)
    results = []
    for cells in args.cells:
        for name in args.scene:
            for solver in args.solver:
                context = multiprocessing.get_context("spawn")
                with context.Pool(1) as pool:
                    settings = (name, cells, solver, args.rtol, args.threads, args.incompressible)
                    found = pool.apply(measure, settings)
                print(line(found), flush=True)
                results.append(found)
    if args.out:
        write_json_atomic(
            args.out, {"machine": machine(), "time": time.strftime("%F"), "results": results}
        )
    return results


if __name__ == "__main__":
    with interruptible():
        main()
