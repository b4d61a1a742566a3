"""Solids: volumes against closed forms, closed boundaries, usable elements."""

import math

import numpy as np
import pytest
import torch

from diffsim import mesh as m
from diffsim.core.errors import MeshError
from diffsim.mesh import sdf
from diffsim.mesh.hinges import hinged_elements
from tests.helpers import observed_order

BALL = 4 / 3 * math.pi * 0.1**3
RING = 2 * math.pi**2 * 0.1 * 0.04**2
UNIT = [[-1.0] * 3, [1.0] * 3]


@pytest.mark.order
@pytest.mark.parametrize(
    "make, exact, resolutions",
    [
        (lambda n: m.hex_sphere(0.1, 0.1 / n), BALL, (4, 8, 16)),
        (lambda n: m.tet_sphere(0.1, 0.1 / n), BALL, (3, 6, 12)),
        (lambda n: m.hex_torus(0.1, 0.04, 0.1 / n), RING, (7, 14, 28)),
        (lambda n: m.tet_torus(0.1, 0.04, 0.1 / n), RING, (4, 8, 16)),
    ],
    ids=["hex ball", "tet ball", "hex ring", "tet ring"],
)
def test_volume_converges_with_the_second_order(make, exact, resolutions):
    h = [1 / n for n in resolutions]
    error = [1 - m.total_volume(make(n)) / exact for n in resolutions]
    assert min(error) > 0  # facets between points of a convex surface; the ring's outside wins
    # chords are off by h^2; 0.25 because lattices and whole numbers of cells do not scale exactly
    assert observed_order(h, error) == pytest.approx(2.0, abs=0.25)


@pytest.mark.parametrize(
    "make, euler",
    [
        (lambda: m.hex_box((3, 2, 4)), 2),
        (lambda: m.tet_box((3, 2, 4)), 2),
        (lambda: m.hex_sphere(0.1, 0.04, (1, 2, 3)), 2),
        (lambda: m.tet_sphere(0.1, 0.04, (1, 2, 3)), 2),
        (lambda: m.hex_torus(0.1, 0.04, 0.025), 0),
        (lambda: m.tet_torus(0.1, 0.04, 0.025), 0),
        (lambda: m.hex_cylinder(0.1, 0.3, 0.05), 2),
        (lambda: m.tet_cylinder(0.1, 0.3, 0.05), 2),
        (lambda: m.hex_from_sdf(sdf.torus(0.6, 0.3), UNIT, 0.15), 0),
    ],
)
def test_boundary_is_closed_and_looks_outwards(make, euler):
    mesh = make()
    surface = m.to_trimesh(mesh)
    assert surface.is_watertight and surface.is_winding_consistent
    assert surface.euler_number == euler
    # divergence theorem: flat triangles against trilinear hexes agree where quads are flat or
    # split symmetrically; coordinates of 3 m cost 1e-12
    tolerance = 1e-10 if mesh.kind == "tet" else 2e-3
    assert surface.volume == pytest.approx(m.total_volume(mesh), rel=tolerance)
    q = m.quality(mesh)
    # what the docstrings promise for smooth surfaces
    assert q.dihedral_angle.minimum > 10 and q.dihedral_angle.maximum < 165
    assert q.scaled_jacobian.minimum > 0.1


def test_parents_of_faces():
    mesh = m.hex_box((3, 2, 2))
    quads = m.surface_quads(mesh)
    nodes = mesh.hexes[quads.element_idx]
    assert bool((quads.faces[:, :, None] == nodes[:, None]).any(dim=2).all())
    assert m.surface_triangles(mesh).element_idx[::2].tolist() == quads.element_idx.tolist()
    assert m.surface_vertices(m.hex_box((2, 2, 2))).tolist() == [i for i in range(27) if i != 13]
    with pytest.raises(TypeError, match="mesh must be a HexMesh, got TetMesh"):
        m.surface_quads(m.tet_box((1, 1, 1)))


@pytest.mark.property
@pytest.mark.parametrize("seed", range(4))
def test_stuffing_creased_solids(seed):
    rng = np.random.default_rng(seed)
    balls = [sdf.sphere(rng.uniform(0.2, 0.4), rng.uniform(-0.4, 0.4, 3)) for _ in range(4)]
    ring = sdf.rotate(sdf.torus(0.5, 0.15), rng.normal(size=3), 1.0)
    shape = sdf.difference(sdf.union(*balls, ring), sdf.cylinder(0.1, 5.0))
    mesh = m.tet_from_sdf(shape, UNIT, 0.12)
    q = m.quality(mesh)
    # isosurface stuffing on a uniform lattice: 10.78 to 164.74 in the paper, 10.2 here (cuts at
    # the true zero, not at the linear one)
    assert q.dihedral_angle.minimum > 9 and q.dihedral_angle.maximum < 165
    surface = m.to_trimesh(mesh)
    assert surface.is_watertight
    assert surface.volume == pytest.approx(q.total_volume, rel=1e-12)
    assert not hinged_elements(mesh.tets.numpy()).any()


def test_nodes_lie_on_the_surface():
    mesh = m.tet_sphere(0.1, 0.02)
    radius = mesh.x_rest[m.surface_vertices(mesh)].norm(dim=1)
    # regula falsi stops at 1e-9 of an edge
    torch.testing.assert_close(radius, torch.full_like(radius, 0.1), rtol=0, atol=1e-9)


def test_voxels():
    mesh = m.hex_from_sdf(sdf.box((0.3, 0.2, 0.1)), [[-0.15, -0.1, -0.05], [0.15, 0.1, 0.05]], 0.05)
    box = m.hex_box((6, 4, 2), (0.3, 0.2, 0.1), (-0.15, -0.1, -0.05))
    assert torch.equal(mesh.hexes, box.hexes)
    torch.testing.assert_close(mesh.x_rest, box.x_rest, rtol=0, atol=1e-15)
    same = m.hex_from_sdf(
        lambda p: np.abs(p / [0.15, 0.1, 0.05]).max(axis=1).astype(float) - 1.0,
        [[-0.15, -0.1, -0.05], [0.15, 0.1, 0.05]],
        0.05,
    )
    assert torch.equal(same.hexes, box.hexes)  # a NumPy callable


def test_loose_parts_and_hinges():
    two = sdf.union(sdf.sphere(0.4, (-0.5, 0, 0)), sdf.sphere(0.2, (0.7, 0, 0)))
    assert len(m.to_trimesh(m.hex_from_sdf(two, UNIT, 0.1, keep="all")).split()) == 2
    assert len(m.to_trimesh(m.hex_from_sdf(two, UNIT, 0.1)).split()) == 1
    assert float(m.tet_from_sdf(two, UNIT, 0.1).x_rest[:, 0].max()) < 0.0
    corners = sdf.union(
        sdf.box((1.0, 1.0, 1.0), (-0.5, -0.5, 0)), sdf.box((1.0,) * 3, (0.5, 0.5, 0))
    )
    whole = m.hex_from_sdf(corners, UNIT, 0.5, keep="all")
    assert m.to_trimesh(whole).is_watertight
    pair = torch.tensor([[0, 1, 2, 3, 4, 5, 6, 7]])
    box = m.hex_box((2, 2, 1))
    assert hinged_elements(box.hexes[[0, 3]].numpy()).tolist() == [False, True]
    assert not hinged_elements(pair.numpy()).any()


def test_messages():
    with pytest.raises(MeshError, match="no cell center of the 2 x 2 x 2 grid lies inside"):
        m.hex_from_sdf(sdf.sphere(0.1), UNIT, 1.0)
    with pytest.raises(MeshError, match="no lattice node lies inside; make spacing smaller"):
        m.tet_from_sdf(sdf.sphere(0.05, (0.3, 0.3, 0.3)), UNIT, 0.9)
    with pytest.raises(MeshError, match="reaches beyond the bounds"):
        m.tet_from_sdf(sdf.plane((0, 0, 1)), UNIT, 0.5)
    with pytest.raises(ValueError, match="did you mean 'largest'"):
        m.hex_from_sdf(sdf.sphere(0.5), UNIT, 0.2, keep="larges")
    with pytest.raises(ValueError, match="sdf must return one value per point"):
        m.hex_from_sdf(lambda p: p, UNIT, 0.5)
    with pytest.raises(ValueError, match="bounds must run from the lower"):
        m.hex_from_sdf(sdf.sphere(0.5), UNIT[::-1], 0.2)
    with pytest.raises(ValueError, match="at most 2e8 are handled"):
        m.hex_from_sdf(sdf.sphere(0.5), UNIT, 1e-3)
    with pytest.raises(ValueError, match=r"spacing must lie in .* at most radius"):
        m.hex_sphere(0.1, 0.2)
    with pytest.raises(ValueError, match="major_radius must lie in"):
        m.hex_torus(0.1, 0.2, 0.05)


@pytest.mark.reference
def test_distances():
    x = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (200, 3)))
    cases = {
        "box": (sdf.box((2.0, 0.5, 0.5)), [2.0, 0, 0], 1.0),
        "cylinder": (sdf.cylinder(0.3, 1.0), [0.7, 0, 0], 0.4),
        "capsule": (sdf.capsule((0, 0, 0), (0, 0, 1), 0.2), [0, 0, 1.5], 0.3),
        "torus": (sdf.torus(1.0, 0.25), [0, 1, 0], -0.25),
        "plane": (sdf.plane((0, 0, 2), 0.5), [0, 0, 2], 1.5),
        "translate": (sdf.translate(sdf.sphere(0.5), (1, 0, 0)), [0, 0, 0], 0.5),
        "rotate": (sdf.rotate(sdf.box((2, 1, 1)), (0, 0, 1), math.pi / 2), [0, 1, 0], 0.0),
        "offset": (sdf.offset(sdf.box((1, 1, 1)), 0.1), [1, 0, 0], 0.4),
        "shell": (sdf.shell(sdf.sphere(0.5), 0.1), [0, 0, 0], 0.45),
    }
    for name, (shape, point, value) in cases.items():
        got = float(shape(torch.tensor([point], dtype=torch.float64)))
        assert got == pytest.approx(value, abs=1e-15), name
        # a distance never changes faster than the point moves
        step = 1e-3 * torch.ones(3, dtype=torch.float64)
        assert float((shape(x + step) - shape(x)).abs().max()) <= 1e-3 * math.sqrt(3) + 1e-15
    inside = sdf.intersection(sdf.sphere(0.5), sdf.plane((1, 0, 0)))(x) < 0
    assert torch.equal(inside, (x.norm(dim=1) < 0.5) & (x[:, 0] < 0))
    with pytest.raises(ValueError, match="at least one shape"):
        sdf.union()


def test_ellipsoid_is_zero_on_its_surface_and_a_sphere_where_it_is_one():
    rng = np.random.default_rng(0)
    rays = torch.from_numpy(rng.normal(size=(50, 3)))
    rays = rays / rays.norm(dim=1, keepdim=True)
    half, center = torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64), (0.1, -0.2, 0.3)
    at = rays * half + torch.tensor(center, dtype=torch.float64)
    shape = sdf.ellipsoid(half, center)
    assert shape(at).abs().max() < 1e-15
    outside = at + 1e-6 * (rays / half) / (rays / half).norm(dim=1, keepdim=True)
    assert shape(outside).numpy() == pytest.approx(1e-6, rel=1e-4)
    assert sdf.ellipsoid((0.2,) * 3)(0.5 * rays).numpy() == pytest.approx(0.3)
    with pytest.raises(ValueError, match="half must lie in"):
        sdf.ellipsoid((0.1, 0.0, 0.1))


def test_smooth_union_fills_the_seam_and_leaves_the_rest():
    a, b = sdf.sphere(0.3, (-0.2, 0, 0)), sdf.sphere(0.3, (0.2, 0, 0))
    x = torch.from_numpy(np.random.default_rng(1).uniform(-1, 1, (500, 3)))
    sharp, smooth = sdf.union(a, b)(x), sdf.smooth_union(a, b, 0.1)(x)
    far = (a(x) - b(x)).abs() >= 0.1
    assert torch.equal(smooth[far], sharp[far])
    assert (smooth <= sharp).all()
    seam = torch.zeros(1, 3, dtype=torch.float64)
    assert float(sdf.smooth_union(a, b, 0.1)(seam) - a(seam)) == pytest.approx(-0.025)
