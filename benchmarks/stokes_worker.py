"""Stokes measurements that are made in a process of their own, so that peak memory is theirs."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from benchmarks.harness import Seconds, cores, spread, timed
from benchmarks.processes import memory, reset_peak_memory
from diffsim.stokes import Grid, Inlet, Open, SolverOptions, StokesFlow, devices
from diffsim.stokes.devices.device import FAILURES, Device, quiet

STEP = 1e-3
"""Between the designs of two calls, as a share of the bounds: every call makes its own system."""


def device(settings: dict[str, Any]) -> dict[str, Any]:
    """Loss, and loss with gradient, of a device near one random design."""
    torch.set_num_threads(1)
    with cores(settings["threads"]), quiet():
        devices.make("amplifier", 0.25).value_and_gradient(torch.full((5,), 0.3).double())  # torch
        made = devices.make(settings["name"], settings["resolution"], **settings["options"])
        made.flow.num_threads = settings["threads"]
        design = a_design(made, settings["seed"])
        found = measure(
            near(made, design, settings["seed"]),
            made.value,
            made.value_and_gradient,
            settings["repetitions"],
        )
        with torch.no_grad():
            report = made.flow.report(made.level_set(design, len(made.states) - 1))
    return {**found, **sizes(report), "shape": made.grid.shape, "num_states": len(made.states)}


def a_design(made: Device, seed: int) -> Tensor:
    """The first random design that lets fluid through; judged on a coarse grid."""
    generator = torch.Generator().manual_seed(seed)
    coarse = devices.DEVICES[made.name](**{**made.options, "resolution": 0.25})
    for _ in range(100):
        design = made.sample(generator)
        try:
            coarse.value(design)
            made.level_set(design)
        except FAILURES:
            continue
        return design
    raise RuntimeError(f"no design of {made.name} lets fluid through")


def near(made: Device, design: Tensor, seed: int) -> Iterator[Tensor]:
    """Designs around one, all different."""
    generator = torch.Generator().manual_seed(seed)
    while True:
        away = torch.randn(len(design), generator=generator, dtype=torch.float64)
        moved = design + STEP * (made.upper - made.lower) * away
        yield torch.minimum(torch.maximum(moved, made.lower), made.upper)


def bent_pipe(cells: int) -> tuple[Grid, Callable[[Tensor], Tensor]]:
    """A round pipe that bends from x- to x+ through a box of n x n x n/2 cells."""
    grid = Grid((cells, cells, cells // 2), size=(1.0, 1.0, 0.5))
    x, y, z = grid.nodes.unbind(-1)
    center = 0.5 + 0.15 * torch.sin(torch.pi * x)
    return grid, lambda radius: radius - torch.hypot(y - center, z - 0.25)


def scaling(settings: dict[str, Any]) -> dict[str, Any]:
    """A solve, and one with gradient, of the bent pipe; the loss is the mean square velocity."""
    torch.set_num_threads(1)
    _scaling({**settings, "cells": 4, "repetitions": 1})  # torch loads what it needs
    return _scaling(settings)


def _scaling(settings: dict[str, Any]) -> dict[str, Any]:
    grid, level = bent_pipe(settings["cells"])
    solver = SolverOptions(method=settings["solver"], num_threads=settings["threads"])
    flow = StokesFlow(grid, [Inlet("x-"), Open("x+")], solver=solver)
    speed = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)

    def loss(radius: Tensor) -> Tensor:
        return flow(level(radius), speed).velocity.square().mean()

    def value(radius: Tensor) -> None:
        with torch.no_grad():
            loss(radius)

    def value_and_gradient(radius: Tensor) -> None:
        loss(radius.clone().requires_grad_()).backward()

    radii = (torch.tensor(0.2 + 1e-4 * k, dtype=torch.float64) for k in range(10**6))
    with cores(settings["threads"]), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        found = measure(radii, value, value_and_gradient, settings["repetitions"])
        report = flow.report(level(torch.tensor(0.2, dtype=torch.float64)))
    return {**found, **sizes(report), "shape": grid.shape}


def measure(
    inputs: Iterator[Tensor],
    value: Callable[[Tensor], object],
    value_and_gradient: Callable[[Tensor], object],
    repetitions: int,
) -> dict[str, Any]:
    """Times of both calls in turn, each with an input of its own, and the peak of memory."""
    start = reset_peak_memory()
    forward: list[Seconds] = []
    both: list[Seconds] = []
    for _ in range(repetitions):
        for call, times in ((value, forward), (value_and_gradient, both)):
            argument = next(inputs)
            times.append(timed(lambda call=call, at=argument: call(at))[1])
    return {
        "forward_wall_s": spread([t.wall for t in forward]),
        "forward_cpu_s": spread([t.cpu for t in forward]),
        "both_wall_s": spread([t.wall for t in both]),
        "both_cpu_s": spread([t.cpu for t in both]),
        "memory_peak_B": memory("VmHWM") - start,
    }


def sizes(report: dict[str, float]) -> dict[str, float]:
    """Sizes of a prepared system, and the speed of its factorization."""
    found = {"num_cells": report["num_cells"], "num_nodes": report["num_nodes"]}
    if flops := report.get("factor_flops"):
        found["factor_s"] = report["factor_s"]
        found["factor_GB"] = report["factor_bytes"] / 1e9
        found["factor_gflops"] = flops / report["factor_s"] / 1e9
    return found
