"""Grids and extracted interfaces: lengths, areas, watertightness, orientation."""

import math

import numpy as np
import pytest
import torch

from diffsim.stokes.shapes import Box, Complement, Plane, Sphere, grid_nodes, interface, sample

F64 = torch.float64


def test_nodes_are_indexed_by_x_y_z():
    nodes = grid_nodes((4, 3, 2), 0.5, (1.0, 2.0, 3.0))
    assert nodes.shape == (5, 4, 3, 3)
    want = torch.tensor([3.0, 2.5, 4.0], dtype=F64)
    torch.testing.assert_close(nodes[4, 1, 2], want)


@pytest.mark.order
@pytest.mark.parametrize("dim", [2, 3])
def test_interface_of_a_ball_converges(dim):
    measure = 2 * math.pi * 0.3 if dim == 2 else 4 * math.pi * 0.09
    errors = []
    cells = [8, 16, 32]
    for n in cells:
        nodes = grid_nodes((n,) * dim, 1.0 / n)
        points, elements = interface(sample(Sphere(0.3, [0.5] * dim), nodes), nodes)
        corners = points[elements]
        first = corners[:, 1] - corners[:, 0]
        if dim == 2:
            size = first.norm(dim=1)
        else:
            normal = torch.linalg.cross(first, corners[:, 2] - corners[:, 0])
            size = 0.5 * normal.norm(dim=1)
        errors.append(abs(float(size.sum()) - measure))
    order = -np.polyfit(np.log(cells), np.log(errors), 1)[0]
    assert 1.7 < order < 2.6  # second order, three coarse grids


@pytest.mark.property
def test_interface_is_watertight_and_faces_the_fluid():
    nodes = grid_nodes((12, 12, 12), 1 / 12)
    for shape, sign in ((Sphere(0.3, (0.5, 0.5, 0.5)), 1), (Box((0.5, 0.4, 0.6), (0.5,) * 3), 1)):
        for solid, turn in ((shape, sign), (Complement(shape), -sign)):
            points, faces = interface(solid(nodes), nodes)
            edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
            both = torch.cat([edges, edges.flip(1)])
            _, counts = both.unique(dim=0, return_counts=True)
            assert (counts == 2).all()  # every edge once in each direction
            a, b, c = points[faces].unbind(1)
            volume = (a * torch.linalg.cross(b, c)).sum() / 6
            assert turn * volume > 0


def test_segments_have_the_fluid_on_their_left():
    nodes = grid_nodes((8, 8), 1 / 8)
    points, segments = interface(sample(Plane((0.0, 1.0), 0.3), nodes), nodes)
    along = points[segments[:, 1]] - points[segments[:, 0]]
    assert (along[:, 0] > 0).all()
    torch.testing.assert_close(points[:, 1], torch.full_like(points[:, 1], 0.3))


@pytest.mark.grad
def test_interface_moves_with_the_shape():
    nodes = grid_nodes((8, 8), 1 / 8)
    offset = torch.tensor(0.3, dtype=F64, requires_grad=True)
    points, _ = interface(sample(Plane((0.0, 1.0), offset), nodes), nodes)
    (grad,) = torch.autograd.grad(points[:, 1].sum(), offset)
    assert grad.item() == pytest.approx(len(points))


def test_errors_say_what_to_do():
    nodes = grid_nodes((8, 8), 1 / 8)
    with pytest.raises(ValueError, match="solid everywhere"):
        sample(Plane((0.0, 1.0), 3.0), nodes)
    with pytest.raises(ValueError, match="num_cells must be"):
        grid_nodes((8,), 0.1)
    points, segments = interface(sample(Plane((0.0, 1.0), -3.0), nodes), nodes)
    assert points.shape == (0, 2) and segments.shape == (0, 2)
