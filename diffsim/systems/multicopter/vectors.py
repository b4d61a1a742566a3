"""Named numbers of flights as vectors; the first axis is that of the points."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor


def stack_points(numbers: Iterable[Tensor]) -> Tensor:
    """Some numbers, () or (points,) each, beside each other, (points, number of them)."""
    return torch.stack(torch.broadcast_tensors(*(n.reshape(-1) for n in numbers)), -1)


def vector_of(values: Mapping[str, Tensor], name: str) -> Tensor:
    """(points, 3) of the numbers name_x, name_y, name_z; 0 where there are none."""
    zero = torch.zeros(1, dtype=torch.float64)
    return stack_points(values.get(f"{name}_{axis}", zero) for axis in "xyz")
