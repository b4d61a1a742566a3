"""A flow holds one factor at a time, whatever number of geometries it has solved."""

from pathlib import Path

import pytest
import torch

from diffsim import stokes

STATUS = Path("/proc/self/status")


def peak() -> int:
    """Largest memory of this process so far [bytes]."""
    lines = (line.split() for line in STATUS.read_text().splitlines())
    return next(1024 * int(line[1]) for line in lines if line[0] == "VmHWM:")


@pytest.mark.skipif(not STATUS.exists(), reason="Linux only")
def test_later_geometries_take_no_more_memory_than_the_first():
    grid = stokes.Grid((20, 18, 16), spacing=1.0 / 16)
    flow = stokes.StokesFlow(grid, [stokes.Inlet("x-"), stokes.Open("x+")])
    speed = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)

    def solve(radius: float) -> None:
        r = torch.tensor(radius, dtype=torch.float64, requires_grad=True)
        field = flow(r - (grid.nodes[..., 1:] - 0.5).norm(dim=-1), speed)
        field.velocity.square().sum().backward()

    solve(0.47)
    factor = flow.report(0.47 - (grid.nodes[..., 1:] - 0.5).norm(dim=-1))["factor_bytes"]
    assert factor > 3e7  # or nothing would be seen
    first = peak()
    for k in range(3):
        solve(0.46 - 0.01 * k)
    assert peak() - first < 0.5 * factor
