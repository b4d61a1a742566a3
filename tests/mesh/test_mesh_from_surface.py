"""Closed surfaces to volume meshes, and what happens when they are not closed."""

import sys
import warnings
from functools import partial

import numpy as np
import pytest
import torch

from diffsim import mesh as m
from diffsim.core.errors import MeshError
from diffsim.mesh.inside import grid_inside


def ball():
    import trimesh

    return trimesh.creation.icosphere(subdivisions=2, radius=0.1)


def test_distance_to_a_box_is_the_closed_form():
    import trimesh

    p = np.random.default_rng(0).uniform(-0.3, 0.3, (500, 3))
    surface = trimesh.creation.box((0.3, 0.1, 0.2))
    q = np.abs(p) - np.array([0.15, 0.05, 0.1])
    exact = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
    # rounding of coordinates of 0.3
    np.testing.assert_allclose(m.SurfaceDistance(surface)(p), exact, rtol=0, atol=1e-15)


def test_the_side_of_a_sharp_corner_does_not_depend_on_how_its_faces_are_cut():
    import trimesh

    # a tetrahedron with one face cut into six slivers that meet at a corner: by these alone, not
    # by their angles, the corner's normal would look along that face's
    corners = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    share = np.linspace(0.0, 1.0, 7)[:, None]
    cut = (1.0 - share) * corners[1] + share * corners[2]
    x = np.vstack([corners[[0, 3]], cut])
    fan = [(0, 2 + k, 3 + k) for k in range(6)] + [(1, 3 + k, 2 + k) for k in range(6)]
    surface = trimesh.Trimesh(x, [*fan, (0, 1, 2), (0, 8, 1)], process=False)
    assert surface.is_volume
    slivers, *others = (surface.face_normals[k] for k in (0, 12, 13))
    away = others[0] + others[1] + 0.1 * slivers  # outside of all three planes, but by the first
    found = m.SurfaceDistance(surface)(corners[:1] + 0.1 * away)
    np.testing.assert_allclose(found, 0.1 * np.linalg.norm(away), rtol=1e-6)


def test_voxels_of_a_box_are_exact():
    import trimesh

    mesh = m.voxelize(trimesh.creation.box((0.3, 0.1, 0.2)), 0.05)
    assert mesh.num_elements == 6 * 2 * 4
    assert m.total_volume(mesh) == pytest.approx(0.3 * 0.1 * 0.2, rel=1e-12)


def test_voxels_agree_with_the_distance():
    import trimesh

    surface = trimesh.creation.torus(0.1, 0.04, major_sections=24, minor_sections=16)
    low, high = surface.bounds
    counts = np.ceil((high - low) / 0.013).astype(np.int64)
    first = 0.5 * (low + high) - 0.5 * 0.013 * (counts - 1)
    inside = grid_inside(surface.vertices, surface.faces, first, 0.013, counts)
    points = first + 0.013 * np.indices(counts).reshape(3, -1).T
    np.testing.assert_array_equal(inside.reshape(-1), m.SurfaceDistance(surface)(points) < 0)
    whole = m.voxelize(surface, 0.013, keep="all")
    # all but the 2 % that hung on by an edge
    assert 0.95 * inside.sum() < whole.num_elements <= inside.sum()


def block():
    import trimesh

    return trimesh.creation.box((0.2, 0.1, 0.1))


@pytest.mark.parametrize("make", [ball, block])
def test_stuffing(make):
    surface = make()
    mesh = m.tetrahedralize(surface, 0.03, method="stuffing")
    assert m.to_trimesh(mesh).is_watertight
    # a spacing of 0.03 on a radius of 0.1: 3 % of chords on top of the icosphere's own
    assert m.total_volume(mesh) == pytest.approx(surface.volume, rel=0.05)
    assert m.quality(mesh).dihedral_angle.minimum > 9


def test_ftetwild(tmp_path, monkeypatch):
    import trimesh

    monkeypatch.chdir(tmp_path)
    pytest.importorskip("pytetwild", reason="pip install pytetwild")
    surface = trimesh.creation.box((0.2, 0.1, 0.1))
    mesh = m.tetrahedralize(surface, 0.05, method="ftetwild")
    # the envelope, 1e-3 of the diagonal, over a third of the width
    assert m.total_volume(mesh) == pytest.approx(0.002, rel=1e-2)
    assert not list(tmp_path.iterdir())


def test_without_ftetwild(monkeypatch):
    monkeypatch.setitem(sys.modules, "pytetwild", None)
    with pytest.raises(ImportError, match=r"pip install .*pytetwild.*use method='stuffing'"):
        m.tetrahedralize(ball(), 0.05, method="ftetwild")
    with pytest.warns(UserWarning, match="pytetwild is not installed.*method='stuffing' silences"):
        m.tetrahedralize(ball(), 0.05)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        m.tetrahedralize(ball(), 0.05, method="stuffing")


def test_open_and_broken_surfaces():
    import trimesh

    s = ball()
    with pytest.raises(MeshError, match=r"not watertight: 3 open edges of .*fill_holes") as e:
        m.voxelize(trimesh.Trimesh(s.vertices, s.faces[1:], process=False), 0.02)
    assert len(e.value.indices) == 3
    faces = s.faces.copy()
    faces[0] = faces[0, ::-1]
    with pytest.raises(MeshError, match="not oriented alike: 3 edges"):
        m.voxelize(trimesh.Trimesh(s.vertices, faces, process=False), 0.02)
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 1]], process=False)
    with pytest.raises(MeshError, match="encloses no volume"):
        m.voxelize(flat, 0.1)
    with pytest.raises(TypeError, match=r"surface must be a trimesh.Trimesh or the path"):
        m.voxelize(3, 0.1)
    with pytest.raises(ValueError, match="tolerance is for method='ftetwild'"):
        m.tetrahedralize(s, 0.05, method="stuffing", tolerance=1e-3)


def test_triangle_soup_and_inside_out_surfaces_are_taken():
    import trimesh

    s = ball()
    soup = trimesh.Trimesh(
        s.vertices[s.faces].reshape(-1, 3),
        np.arange(3 * len(s.faces)).reshape(-1, 3),
        process=False,
    )
    soup.invert()
    mesh, same = m.voxelize(soup, 0.02), m.voxelize(s, 0.02)
    assert torch.equal(mesh.hexes, same.hexes)
    # a staircase of ten cells over the diameter misses some 5 % of the volume
    assert m.total_volume(mesh) == pytest.approx(s.volume, rel=0.1)


@pytest.mark.parametrize("make", [m.voxelize, partial(m.tetrahedralize, method="stuffing")])
def test_a_part_in_millimeters_is_asked_for_its_unit(tmp_path, make):
    import trimesh

    trimesh.creation.box((80.0, 20.0, 10.0)).export(tmp_path / "part.stl")
    with pytest.raises(ValueError, match=r"it is 80 m long: millimeters\? scale=1e-3"):
        make(tmp_path / "part.stl", 5e-3)
    made = make(m.load_surface(tmp_path / "part.stl", scale=1e-3), 5e-3)
    assert float(np.ptp(made.x_rest.numpy()[:, 0])) == pytest.approx(0.08, abs=5e-3)
    with pytest.raises(ValueError, match=r"increase spacing$"):  # of a body of 80 mm
        make(m.load_surface(tmp_path / "part.stl", scale=1e-3), 1e-6)
