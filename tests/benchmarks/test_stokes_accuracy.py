"""benchmarks/stokes_accuracy.py at tiny size: its exact flows are exact, and its tables right."""

import json

import pytest
import torch

from benchmarks import stokes_accuracy
from benchmarks.stokes_exact import Exact, all_flows


@pytest.mark.parametrize("exact", all_flows(), ids=lambda e: e.name)
def test_exact_flows_have_no_divergence_and_a_gradient_of_pressure_as_force(exact: Exact):
    """div v = 0, and the curl of the Laplacian vanishes: some pressure balances it."""
    generator = torch.Generator().manual_seed(0)
    corner = torch.tensor(exact.origin, dtype=torch.float64)
    points = corner + exact.size * torch.rand(200, 2, generator=generator, dtype=torch.float64)
    points = points[exact.level(points) > 0.0]
    assert len(points) > 20
    jacobian = torch.func.jacrev(exact.velocity)

    def curl(x: torch.Tensor) -> torch.Tensor:
        slopes = jacobian(x)
        return slopes[1, 0] - slopes[0, 1]

    laplacian_of_curl = torch.func.vmap(
        lambda x: torch.func.jacrev(torch.func.jacrev(curl))(x).trace()
    )
    slopes = torch.func.vmap(jacobian)(points)
    assert float((slopes[:, 0, 0] + slopes[:, 1, 1]).abs().max()) < 1e-12
    scale = float(slopes.norm(dim=(1, 2)).max()) / 0.1**2  # lengths of a tenth
    assert float(laplacian_of_curl(points).abs().max()) < 1e-12 * scale


@pytest.mark.parametrize("exact", all_flows(), ids=lambda e: e.name)
def test_exact_flows_meet_their_wall(exact: Exact):
    """Points moved onto the wall along the slope of the level set."""
    grid = exact.grid(32)
    points = grid.nodes.reshape(-1, 2)
    points = points[exact.level(points).abs() < 0.5 * grid.spacing[0]]
    for _ in range(4):
        at = points.detach().requires_grad_()
        (normal,) = torch.autograd.grad(exact.level(at).sum(), at)
        points = (at - exact.level(at)[:, None] * normal).detach()
    relative = exact.velocity(points)
    if exact.wall_velocity is not None:
        relative = relative - exact.wall_velocity(points)
    if exact.wall == "no_separation":
        relative = (relative * normal).sum(-1)
    assert float(relative.abs().max()) < 1e-12


def test_report_and_figure(tmp_path):
    stokes_accuracy.main(["--cells", "12", "16", "--ratios", "0.3", "0.49", "--out", str(tmp_path)])
    results = json.loads((tmp_path / "results.json").read_text())
    assert len(results["rows"]) == 5 * (2 + 3) * 2  # flows, formulations and ratios, grids
    assert all(0.0 < row["error"] < 1.0 for row in results["rows"])
    text = (tmp_path / "report.md").read_text()
    assert text.count("| published, nu = 0.3 |") == 5
    assert text.count("| default |") == 5
    assert text.count("| prototype |") == 4  # its flow past a disk was not recorded
    assert text.count("| default, nu = 0.3 |") == 5
    for name in ("accuracy.png", "accuracy.svg"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_order_is_that_of_the_ends():
    rows = [
        {"cells": 16, "error": 4e-2},
        {"cells": 32, "error": 5e-2},
        {"cells": 64, "error": 1e-2},
    ]
    assert stokes_accuracy.order(rows) == pytest.approx(1.0)
