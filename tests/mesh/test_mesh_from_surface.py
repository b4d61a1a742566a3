"""Closed surfaces to volume meshes, and what happens when they are not closed."""

import sys
import warnings
from functools import partial

import numpy as np
import pytest
import torch

from diffsim import mesh as m
from diffsim.core.errors import MeshError
from diffsim.mesh.closed_surface import crossing_triangles
from diffsim.mesh.from_surface import grid_inside


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
        m.tetrahedralize(ball(), 0.015, method="stuffing")


def joined(*parts):
    import trimesh

    return trimesh.util.concatenate(parts)


def cube(place, edge=0.1, *, inwards=False):
    import trimesh

    out = trimesh.creation.box((edge,) * 3, trimesh.transformations.translation_matrix(place))
    if inwards:
        out.invert()
    return out


@pytest.mark.parametrize("fill", [m.voxelize, partial(m.tetrahedralize, method="stuffing")])
def test_no_body_is_lost_in_silence(fill):
    two = joined(cube((0.0, 0.0, 0.0)), cube((0.3, 0.0, 0.0)))
    with pytest.raises(MeshError, match=r"encloses 2 bodies apart.*keep='all' or keep='largest'"):
        fill(two, 0.02)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert m.total_volume(fill(two, 0.02, keep="all")) == pytest.approx(2e-3, rel=0.01)
    with pytest.warns(UserWarning, match="50 % less volume"):
        assert m.total_volume(fill(two, 0.02, keep="largest")) == pytest.approx(1e-3, rel=0.01)
    with pytest.warns(UserWarning, match="% (less|more) volume, and so mass"):
        fill(ball(), 0.06)


def test_cavities_are_turned_inwards():
    cavity = joined(cube((0.0, 0.0, 0.0)), cube((0.0, 0.0, 0.0), 0.06, inwards=True))
    mesh = m.voxelize(cavity, 0.02)
    assert m.total_volume(mesh) == pytest.approx(0.1**3 - 0.06**3, rel=1e-9)
    kept = joined(cavity, cube((0.0, 0.0, 0.0), 0.02))  # a body in the cavity
    assert m.total_volume(m.voxelize(kept, 0.02, keep="all")) == pytest.approx(
        0.1**3 - 0.06**3 + 0.02**3, rel=1e-9
    )
    with pytest.raises(MeshError, match=r"triangle 12, near \(.*lies within another one"):
        m.voxelize(joined(cube((0.0, 0.0, 0.0)), cube((0.0, 0.0, 0.0), 0.06)), 0.02)
    with pytest.raises(MeshError, match=r"triangle 12, .*is turned inside out"):
        m.voxelize(joined(cube((0.0, 0.0, 0.0)), cube((0.3, 0.0, 0.0), 0.06, inwards=True)), 0.02)


def test_surfaces_that_cross_themselves_are_named():
    """Against a brute force over edges and triangles, in lengths along the edges."""
    rng = np.random.default_rng(3)
    surface = ball()
    bent = surface.vertices.copy()
    top = bent[:, 2] > 0.08
    bent[top, 2] -= 0.22  # through the other side
    overlap = joined(surface, cube((0.099, 0.013, 0.007)))
    for x, faces in ((bent, surface.faces), (overlap.vertices, overlap.faces)):
        x = x + 1e-6 * rng.normal(size=x.shape)
        found = {tuple(sorted(p)) for p in crossing_triangles(x, faces, 10**6).tolist()}
        assert found and found == crossed_one_by_one(x, np.asarray(faces))
    # of a symmetric surface edges run through edges
    assert len(crossing_triangles(bent, surface.faces)) > 10
    with pytest.raises(MeshError, match=r"crosses itself: triangles \d+ and \d+,.*near \(") as e:
        m.voxelize(overlap, 0.02)
    assert {k >= len(surface.faces) for k in e.value.indices} == {True, False}
    touching = joined(cube((0.0, 0.0, 0.0)), cube((0.05, 0.03, 0.1)))
    for sound in (surface, touching, surface.subdivide()):
        assert len(crossing_triangles(sound.vertices, sound.faces)) == 0


def crossed_one_by_one(x, faces):
    out = set()
    for i, one in enumerate(faces):
        for k in range(3):
            start, end = x[one[k]], x[one[(k + 1) % 3]]
            a, b, c = x[faces.T]
            # start + t (end - start) = a + u (b - a) + v (c - a)
            way = np.broadcast_to(start - end, a.shape)
            matrix = np.stack([b - a, c - a, way], axis=2)
            good = np.abs(np.linalg.det(matrix)) > 1e-16
            u, v, t = np.linalg.solve(matrix[good], (start - a[good])[..., None])[..., 0].T
            inner = (u > 0) & (v > 0) & (u + v < 1) & (t > 0) & (t < 1)
            for j in np.flatnonzero(good)[inner]:
                if len(set(one) & set(faces[j])) == 0:
                    out.add((min(i, int(j)), max(i, int(j))))
    return out


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
