"""Grids and level sets on them."""

from __future__ import annotations

import pytest
import torch

from diffsim.stokes.shapes import Plane, grid_nodes, sample

F64 = torch.float64


def test_nodes_are_indexed_by_x_y_z():
    nodes = grid_nodes((4, 3, 2), 0.5, (1.0, 2.0, 3.0))
    assert nodes.shape == (5, 4, 3, 3)
    want = torch.tensor([3.0, 2.5, 4.0], dtype=F64)
    torch.testing.assert_close(nodes[4, 1, 2], want)


def test_errors_say_what_to_do():
    nodes = grid_nodes((8, 8), 1 / 8)
    with pytest.raises(ValueError, match="solid everywhere"):
        sample(Plane((0.0, 1.0), 3.0), nodes)
    with pytest.raises(ValueError, match="num_cells must be"):
        grid_nodes((8,), 0.1)
    with pytest.raises(ValueError, match="spacing must lie in"):
        grid_nodes((8, 8), 0.0)
    assert (sample(Plane((0.0, 1.0), -3.0), nodes) > 0).all()
