"""Tetrahedra split in eight, boxes of mirrored cells, families of shapes of a mesh."""

import numpy as np
import pytest
import torch

from diffsim import mesh
from diffsim.core.errors import MeshError
from tests.soft.cases import irregular_mesh, noise


def faces_inside_out(m) -> tuple[int, int]:
    """Faces that one tetrahedron has, and that two have; more would be no mesh."""
    corners = m.tets[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)
    count = np.unique(np.sort(corners.numpy(), axis=1), axis=0, return_counts=True)[1]
    assert count.max() == 2
    return int((count == 1).sum()), int((count == 2).sum())


def test_eighths_fill_their_tetrahedra_and_share_faces():
    coarse = mesh.tet_box((2, 1, 1), (1.0, 0.4, 0.3))
    fine = mesh.split_tets(coarse)
    assert fine.num_nodes == coarse.num_nodes + len(coarse.edges())
    parts = mesh.element_volumes(fine).reshape(-1, 8)
    whole = mesh.element_volumes(coarse)
    torch.testing.assert_close(parts, (whole / 8.0)[:, None].expand(-1, 8))
    assert torch.equal(fine.x_rest[: coarse.num_nodes], coarse.x_rest)
    outside, inside = faces_inside_out(coarse)
    fine_outside, fine_inside = faces_inside_out(fine)
    assert (fine_outside, fine_inside) == (4 * outside, 4 * inside + 8 * coarse.num_elements)
    with pytest.raises(TypeError, match="must be a TetMesh, got HexMesh"):
        mesh.split_tets(mesh.hex_box((1, 1, 1)))


@pytest.mark.parametrize("cells", [(2, 4, 2), (3, 2, 1)])
def test_symmetric_boxes_are_their_own_mirror_images(cells):
    """On every axis of an even number of cells; tet_box without it is so on none."""

    def tets_of(m, mirrored=None):
        x = m.x_rest.clone()
        if mirrored is not None:
            x[:, mirrored] = cells[mirrored] - x[:, mirrored]
        corners = x[m.tets].numpy() @ np.array([1.0, 100.0, 10_000.0])
        return {tuple(sorted(row)) for row in np.round(corners, 6)}

    size = tuple(float(n) for n in cells)
    m = mesh.tet_box(cells, size, symmetric=True)
    assert float(mesh.element_volumes(m).sum()) == pytest.approx(np.prod(size))
    faces_inside_out(m)
    plain = mesh.tet_box(cells, size)
    for axis in range(3):
        assert (tets_of(m, axis) == tets_of(m)) == (cells[axis] % 2 == 0)
        assert tets_of(plain, axis) != tets_of(plain)


@pytest.mark.parametrize("points", [(6, 2, 3), (2, 4, 5)])
def test_a_cage_reproduces_linear_fields(points):
    """Control points moved by an affine map take all nodes along; a sum of all moves them alike."""
    m = irregular_mesh("hex", (3, 2, 2))
    cage = mesh.Cage(m, points)
    assert torch.equal(cage(torch.zeros(*cage.shape, dtype=torch.float64)), m.x_rest)
    stretch, push = 0.3 * noise(3, 3), noise(3, seed=1)
    moved = cage(cage.rest @ stretch + push)
    torch.testing.assert_close(moved, m.x_rest + m.x_rest @ stretch + push, rtol=0, atol=1e-13)


def test_a_corner_of_the_cage_moves_the_corner_of_the_mesh():
    m = mesh.hex_box((4, 2, 2), (2.0, 1.0, 1.0))
    cage = mesh.Cage(m, (5, 3, 3))
    offsets = torch.zeros(*cage.shape, dtype=torch.float64)
    offsets[-1, 0, 0] = torch.tensor([0.1, 0.2, 0.3])
    away = cage(offsets) - m.x_rest
    corner = (m.x_rest == torch.tensor([2.0, 0.0, 0.0])).all(1)
    torch.testing.assert_close(away[corner][0], offsets[-1, 0, 0], rtol=0, atol=1e-15)
    assert not away[m.x_rest[:, 0] == 0.0].any()


def test_blends():
    m = irregular_mesh("tet", (1, 1, 1))
    shapes = m.x_rest + 0.1 * noise(2, *m.x_rest.shape)
    blend = mesh.Blend(m, shapes)
    for k in range(2):
        torch.testing.assert_close(blend(torch.eye(2, dtype=torch.float64)[k]), shapes[k])


@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_a_step_that_would_invert_an_element_is_shortened_and_said(kind):
    m = (mesh.hex_box if kind == "hex" else mesh.tet_box)((2, 2, 2), (2.0, 2.0, 2.0))
    inner = (m.x_rest == 1.0).all(1)
    moved = m.x_rest + torch.where(inner[:, None], 3.0 * torch.ones(3).double(), 0.0)
    with pytest.warns(UserWarning, match=r"shortened to 1/[0-9]+: element \d would keep less"):
        share = mesh.safe_share(m, m.x_rest, moved)
    type(m)(m.x_rest + share * (moved - m.x_rest), m.elements)  # is one
    assert mesh.safe_share(m, m.x_rest, m.x_rest + 0.03 * (moved - m.x_rest)) == 1.0
    with pytest.raises(MeshError, match="before the step"):
        mesh.safe_share(m, moved, m.x_rest + 2.0 * (moved - m.x_rest))
