"""Tetrahedra split in eight, and boxes of mirrored cells."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from diffsim import mesh


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
