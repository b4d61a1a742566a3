"""Families of shapes of a mesh."""

from __future__ import annotations

import pytest
import torch

from diffsim import mesh
from diffsim.core.errors import MeshError
from tests.soft.cases import irregular_mesh, noise


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
