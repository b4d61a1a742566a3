"""The rod of benchmarks/members.py: tapered, twelve elements, two tendons, a load, pressed rubber.

Each pose is found from strains that are 2 % off, with and without gradients of all its numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from diffsim.systems.rod import _ops
from diffsim.systems.rod.layout import points_on, rod_shape
from diffsim.systems.rod.statics import RodStatics

YOUNG, TOLERANCE = 5e5, 1e-9


def tentacle(count: int) -> RodStatics:
    """So many rods that differ by their tensions."""
    shape = rod_shape(np.array([0.0, 0.36]), np.array([0.015, 0.005]), 12, [])
    each = len(shape.radius)
    offset = torch.zeros(2, each, 3, dtype=torch.float64)
    offset[0, :, 1], offset[1, :, 2] = 0.008, 0.008
    one = torch.ones((), dtype=torch.float64)
    pull = torch.linspace(0.5, 2.0, count, dtype=torch.float64)[:, None, None] * one.expand(1, 2)
    weight = -1100.0 * 9.81 * shape.area * shape.lengths
    down = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return RodStatics(
        shape=shape,
        bending=YOUNG * shape.inertia[:, None] * one.expand(3),
        stretch=YOUNG * shape.area[:, None] * one.expand(3),
        rest=torch.zeros(each, 3, dtype=torch.float64),
        stiffening=0.0 * one,
        weight=weight[:, None] * down,
        points=points_on(shape, ["tip"], [0.36], [(0.0, 0.0, 0.01)]),
        loads=-0.02 * down[None],
        base=torch.eye(3, dtype=torch.float64),
        place=torch.zeros(3, dtype=torch.float64),
        offset=offset,
        slope=torch.zeros_like(offset),
        share=one.expand(2, each),
        pull=pull,
        friction=0.1 * one,
        wobble=0.0 * one,
        rubber=one,
    )


def calls_of(count: int) -> dict[str, Callable[[], object]]:
    """What is timed, of so many rods."""
    rod = tentacle(count)
    seen = rod.points
    start = torch.zeros(count, 1, len(rod.shape.radius), 3, dtype=torch.float64)
    u, _ = rod.solve(seen, seen.offset, start, TOLERANCE, straight=True)
    near = 1.02 * u
    numbers = {n: getattr(rod, n).clone().requires_grad_() for n in _ops.FIELDS if n != "points"}
    followed = replace(rod, **numbers)

    def differentiate() -> object:
        places = followed.solve(seen, seen.offset, near, TOLERANCE)[1]
        return torch.autograd.grad(places.square().sum(), list(numbers.values()))

    return {
        "`rod`, pose": lambda: rod.solve(seen, seen.offset, near, TOLERANCE),
        "`rod`, pose with gradient": differentiate,
    }
