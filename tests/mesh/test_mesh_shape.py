"""Shape-function gradients: exact on linear fields, one class for a regular grid."""

import numpy as np
import pytest
import torch

from diffsim import mesh as m
from diffsim.mesh.reference import HEX_GAUSS, hex_shape, hex_shape_derivatives


def distorted(make):
    """A box whose nodes are moved by up to a sixth of a cell."""
    mesh = make((3, 4, 2), (0.3, 0.4, 0.2), (1.0, -2.0, 3.0))
    moved = torch.from_numpy(np.random.default_rng(0).uniform(-0.016, 0.016, mesh.x_rest.shape))
    return type(mesh)(mesh.x_rest + moved, mesh.elements)


@pytest.fixture(params=["hex box", "tet box", "hex distorted", "tet distorted", "hex ball"])
def mesh(request):
    return {
        "hex box": lambda: m.hex_box((3, 4, 2), (0.3, 0.4, 0.2), (1.0, -2.0, 3.0)),
        "tet box": lambda: m.tet_box((3, 4, 2), (0.3, 0.4, 0.2), (1.0, -2.0, 3.0)),
        "hex distorted": lambda: distorted(m.hex_box),
        "tet distorted": lambda: distorted(m.tet_box),
        "hex ball": lambda: m.hex_sphere(0.1, 0.05),
    }[request.param]()


def test_layout(mesh):
    s = m.shape_gradients(mesh)
    quad, nodes = (8, 8) if mesh.kind == "hex" else (1, 4)
    assert s.grad.shape[1:] == (quad, nodes, 3) and s.weight.shape == s.grad.shape[:2]
    assert s.class_idx.shape == (mesh.num_elements,) and s.class_idx.dtype == torch.int64
    assert all(t.is_contiguous() for t in (s.grad, s.weight, s.class_idx))
    assert bool((s.weight > 0).all())


@pytest.mark.property
def test_linear_fields_are_reproduced(mesh):
    s = m.shape_gradients(mesh)
    A = torch.from_numpy(np.random.default_rng(1).normal(size=(3, 3)))
    x = mesh.x_rest @ A.T + 0.7
    F = torch.einsum("eai,eqaj->eqij", x[mesh.elements], s.grad[s.class_idx])
    # 1e-12 is what counts as congruent; coordinates of 3 m over cells of 0.1 m cost 30 eps
    torch.testing.assert_close(F, A.expand_as(F), rtol=0, atol=1e-11)


@pytest.mark.property
def test_gradients_sum_to_zero_and_nodal_volumes_to_the_volume(mesh):
    s = m.shape_gradients(mesh)
    # the sum of 8 terms of the size of 1 / (cell size)
    assert float(s.grad.sum(dim=2).abs().max()) < 1e-13 * float(s.grad.abs().max())
    nodes = m.nodal_volume(mesh)
    assert float(nodes.sum()) == pytest.approx(m.total_volume(mesh), rel=1e-13)


def test_volume_of_distorted_hexes_equals_the_flux_through_bilinear_faces():
    mesh = distorted(m.hex_box)
    faces = mesh.x_rest[m.surface_quads(mesh).faces].numpy()
    g = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
    flux = 0.0
    for u in g:
        for v in g:  # x.n dA / 3 of a bilinear patch is of degree 3 in u and v: 2x2 Gauss is exact
            a, b, c, d = faces.transpose(1, 0, 2)
            x = (1 - u) * (1 - v) * a + u * (1 - v) * b + u * v * c + (1 - u) * v * d
            xu = (1 - v) * (b - a) + v * (c - d)
            xv = (1 - u) * (d - a) + u * (c - b)
            flux += (x * np.cross(xu, xv)).sum() / 12.0
    # coordinates of 3 m around a volume of 0.024 m^3: cancellation of 4e3 eps
    assert m.total_volume(mesh) == pytest.approx(flux, rel=1e-11)


def test_nodal_volumes_of_a_distorted_hex_are_the_integrals_of_its_shape_functions():
    x = m.hex_box((1, 1, 1)).x_rest.numpy() + np.random.default_rng(2).uniform(-0.2, 0.2, (8, 3))
    mesh = m.HexMesh(torch.from_numpy(x), torch.arange(8)[None])
    t, w = np.polynomial.legendre.leggauss(4)
    points = np.stack(np.meshgrid(*[0.5 + 0.5 * t] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    weight = np.einsum("i,j,k->ijk", w, w, w).reshape(-1) / 8.0
    det = np.linalg.det(np.einsum("ai,pac->pic", x, hex_shape_derivatives(points)))
    # N det J is of degree 3 in each coordinate: both rules are exact
    exact = (hex_shape(points) * (weight * det)[:, None]).sum(axis=0)
    np.testing.assert_allclose(m.nodal_volume(mesh).numpy(), exact, rtol=1e-13)


def test_nearly_congruent_elements_do_not_share_a_row():
    box = m.hex_box((3, 1, 1))
    x = box.x_rest.clone()
    x[12:, 0] += 1e-9
    assert m.shape_gradients(m.HexMesh(x, box.hexes)).class_idx.tolist() == [0, 0, 1]
    x[12:, 0] += 1e-15 - 1e-9
    assert m.shape_gradients(m.HexMesh(x, box.hexes)).class_idx.tolist() == [0, 0, 0]


def test_derivatives_are_those_of_the_shape_functions():
    h = 1e-6
    for c in range(3):
        step = h * np.eye(3)[c]
        central = (hex_shape(HEX_GAUSS + step) - hex_shape(HEX_GAUSS - step)) / (2 * h)
        # trilinear: the difference is exact up to eps / h
        np.testing.assert_allclose(hex_shape_derivatives(HEX_GAUSS)[..., c], central, atol=1e-9)
    np.testing.assert_allclose(hex_shape(HEX_GAUSS).sum(axis=1), 1.0, rtol=1e-15)


def test_congruent_elements_share_a_row():
    assert len(m.shape_gradients(m.hex_box((7, 5, 3), (0.1, 0.13, 0.07), (9.1, 3, -7.7))).grad) == 1
    ball = m.hex_from_sdf(m.sdf.sphere(0.1), [[-0.1] * 3, [0.1] * 3], 0.013)
    s = m.shape_gradients(ball)
    assert len(s.grad) == 1
    # the cube: dN/dX = +-(1 +- 1/sqrt 3)... / h; weight h^3 / 8
    torch.testing.assert_close(s.weight, torch.full((1, 8), 0.013**3 / 8, dtype=torch.float64))
    assert len(m.shape_gradients(distorted(m.hex_box)).grad) == 24
    mixed = m.hex_box((3, 1, 1)).x_rest.clone()
    mixed[12:, 0] += 0.5  # the last cell is longer
    s = m.shape_gradients(m.HexMesh(mixed, m.hex_box((3, 1, 1)).hexes))
    assert s.class_idx.tolist() == [0, 0, 1]


def test_quality_and_sizes():
    q = m.quality(m.hex_box((2, 3, 4), (0.2, 0.3, 0.8)))
    assert q.scaled_jacobian.minimum == pytest.approx(1.0, rel=1e-12)
    assert q.dihedral_angle.minimum == pytest.approx(90.0, rel=1e-12)
    assert q.aspect_ratio.maximum == pytest.approx(2.0, rel=1e-12)
    assert q.volume_ratio == pytest.approx(1.0, rel=1e-12)
    assert "24 hex elements, 60 nodes" in str(q) and "scaled Jacobian" in str(q)
    x = torch.tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=torch.float64)
    regular = m.quality(m.TetMesh(*m.flip_inverted(x, torch.tensor([[0, 1, 2, 3]]))))
    assert regular.scaled_jacobian.minimum == pytest.approx(1.0, rel=1e-12)
    assert regular.dihedral_angle.maximum == pytest.approx(np.degrees(np.arccos(1 / 3)), rel=1e-12)
    torch.testing.assert_close(
        m.element_size(m.hex_box((1, 1, 1), (1, 2, 3))), torch.tensor([2.0], dtype=torch.float64)
    )
