"""Tendons: routing through elements, energy that does not depend on the mesh, closed forms."""

import copy
import math

import numpy as np
import pytest
import torch

from diffsim import mesh, soft
from diffsim.soft.routing import route
from tests.covering import covering
from tests.helpers import tensor as f64
from tests.soft.cases import SHARP, deformed, irregular_mesh, soft_body

BENT = [[0.1, 0.15, 0.2], [0.9, 0.7, 0.35], [1.85, 0.3, 0.8]]  # inside the 2 x 1 x 1 box


def sheared_box():
    """A box of parallelepipeds, borders known in closed form."""
    box = mesh.hex_box((4, 2, 2), (2.0, 1.0, 1.0))
    shear = f64([[1.0, 0.3, 0.2], [0.0, 1.0, 0.1], [0.0, 0.0, 1.0]])
    return mesh.HexMesh(box.x_rest @ shear.T, box.hexes), shear


def slender(kind, cells=(10, 1, 1)):
    return (mesh.hex_box if kind == "hex" else mesh.tet_box)(cells, (1.0, 0.1, 0.1))


def polyline_length(points):
    return points.diff(dim=-2).norm(dim=-1).sum(-1)


# routing


@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_pieces_lie_in_their_elements_and_sum_to_the_path(kind):
    m = irregular_mesh(kind, cells=(4, 3, 3), amount=0.02)
    path = f64(BENT)
    found = route(m, path.numpy())
    assert found.length.sum() == pytest.approx(float(polyline_length(path)), rel=1e-14)
    assert len(found.elements) > 8
    # a piece no longer than its element is wide, and walked in order the pieces retrace the path
    start = path[0].numpy()
    for e, direction, length in zip(found.elements, found.direction, found.length, strict=True):
        middle = start + 0.5 * length * direction
        corners = m.x_rest[m.elements[e]].numpy()
        assert (corners.min(0) - 1e-9 <= middle).all() and (middle <= corners.max(0) + 1e-9).all()
        start = start + length * direction
    np.testing.assert_allclose(start, path[-1].numpy(), atol=1e-9)


def test_borders_of_parallelepipeds_are_exact():
    """In reference coordinates the box is a grid: crossings are known."""
    m, shear = sheared_box()
    ends = f64([[0.1, 0.2, 0.3], [1.9, 0.9, 0.6]])
    found = route(m, (ends @ shear.T).numpy())
    # crossings of x = 0.5, 1, 1.5 at t = 2/9, 1/2, 7/9; of y = 0.5 at 3/7; of z = 0.5 at 2/3
    t = np.array([0, 2 / 9, 3 / 7, 1 / 2, 2 / 3, 7 / 9, 1])
    size = float(((ends[1] - ends[0]) @ shear.T).norm())
    np.testing.assert_allclose(found.length, np.diff(t) * size, rtol=1e-12)
    assert found.elements.tolist() == [0, 4, 6, 10, 11, 15]


def test_tetrahedra_agree_with_the_hexahedra_they_split():
    boxes = [f((4, 2, 2), (2.0, 1.0, 1.0)) for f in (mesh.hex_box, mesh.tet_box)]
    path = np.array(BENT)
    per_cell = []
    for m, split in zip(boxes, (1, 6), strict=True):
        found = route(m, path)
        per_cell.append(np.bincount(found.elements // split, found.length, minlength=16))
    np.testing.assert_allclose(*per_cell, atol=1e-12)


def test_a_path_along_a_shared_face_is_shared():
    m = mesh.hex_box((2, 2, 2), (2.0, 2.0, 2.0))
    found = route(m, np.array([[0.25, 1.0, 1.0], [0.75, 1.0, 1.0]]))  # an edge of four cells
    assert sorted(found.elements.tolist()) == [0, 1, 2, 3]
    np.testing.assert_allclose(found.length, 0.125, rtol=1e-12)
    on = route(m, np.array([[0.25, 1.0, 1.0], [0.75, 1.0, 1.0], [0.75, 0.5, 0.5]]))  # into cell 0
    assert on.elements[4:].tolist() == [0]
    np.testing.assert_allclose(on.length, [0.125] * 4 + [0.5**0.5], rtol=1e-12)
    on_surface = route(m, np.array([[0.2, 0.0, 0.5], [1.6, 0.0, 0.5]]))
    np.testing.assert_allclose(on_surface.length, [0.8, 0.6], rtol=1e-9)


def test_a_path_outside_says_how_much_and_where():
    m = mesh.tet_box((4, 2, 2), (2.0, 1.0, 1.0))
    message = r"0.5 m of its 2 m \(25.0%\) lie outside, around \(2.25, 0.5, 0.5\) m; move"
    with pytest.raises(ValueError, match=message):
        soft.Tendon(m, [[0.5, 0.5, 0.5], [2.5, 0.5, 0.5]], axial_stiffness=1.0)
    hexes = mesh.hex_box((4, 2, 2), (2.0, 1.0, 1.0))
    with pytest.raises(ValueError, match=r"\(100.0%\) lie outside"):
        soft.Tendon(hexes, [[5.0, 0.5, 0.5], [6.0, 0.5, 0.5]], axial_stiffness=1.0)
    keep = (hexes.x_rest[hexes.hexes].mean(1)[:, 0] - 0.75).abs() > 0.1  # a gap at 0.5 < x < 1
    used, local = torch.unique(hexes.hexes[keep], return_inverse=True)
    gap = mesh.HexMesh(hexes.x_rest[used], local)
    with pytest.raises(ValueError, match=r"0.5 m of its 1.8 m .* around \(0.75, 0.4, 0.4\)"):
        soft.Tendon(gap, [[0.1, 0.4, 0.4], [1.9, 0.4, 0.4]], axial_stiffness=1.0)


# energy, length, tension


@pytest.mark.reference
@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_energy_of_a_homogeneous_deformation(kind):
    """E = EA/2 sum over segments |seg| (|F t| - a)^2, on any mesh; the kernel agrees."""
    m = irregular_mesh(kind, cells=(3, 2, 2), amount=0.03)
    tendon = soft.Tendon(m, BENT, axial_stiffness=7.0)
    body = soft_body(m, muscles=[tendon.muscle])
    plain = soft_body(m)
    F = f64([[1.2, 0.3, 0.0], [-0.2, 0.9, 0.4], [0.1, -0.3, 0.8]])
    x = m.x_rest @ F.T
    a = tendon.activation(0.8 * tendon.rest_length)
    segments = f64(BENT).diff(dim=0)
    rest, now = segments.norm(dim=1), (segments @ F.T).norm(dim=1)
    expected = 3.5 * (rest * (now / rest - 0.8) ** 2).sum()
    energy = body.elastic_energy(x, activation=a[None]) - plain.elastic_energy(x)
    torch.testing.assert_close(energy, expected, rtol=1e-10, atol=0)
    torch.testing.assert_close(tendon.length(x), now.sum())
    torch.testing.assert_close(tendon.length(m.x_rest), f64(tendon.rest_length))


@pytest.mark.reference
@covering(kind=["hex", "tet"], slack=[True, False], a=[0.8, 1.6])
def test_tension_is_what_the_energy_says(kind, slack, a):
    """-dE/da = sum L_e T_e, taut and loose: E is quadratic in a, differences are exact."""
    m = irregular_mesh(kind, cells=(3, 2, 2), amount=0.03)
    tendon = soft.Tendon(m, BENT, axial_stiffness=7.0, slack=slack)
    body = soft_body(m, muscles=[tendon.muscle])
    x = deformed(m, amount=0.1)
    energy = [body.elastic_energy(x, activation=f64([b])) for b in (a - 0.1, a + 0.1)]
    tension = tendon.tension(x, a)
    torch.testing.assert_close((energy[0] - energy[1]) / 0.2, (tension * tendon.piece_length).sum())
    if slack and a > 1.0:
        assert not bool(tension.any())  # a loose cable does not push
    else:
        assert tension.std() > 0.1  # bonded: pieces differ
    doubled = tendon.tension(x, a, axial_stiffness=f64(14.0))
    torch.testing.assert_close(doubled, 2 * tension)


@pytest.mark.reference
@pytest.mark.parametrize("sections", [1, 3])
def test_contraction_of_a_bar(sections):
    """nu = 0, a tendon in the axis of a bar: stretch = (E A + EA a) / (E A + EA)."""
    m = slender("hex", cells=(10, sections, sections))
    tendon = soft.Tendon(m, [[0, 0.05, 0.05], [1, 0.05, 0.05]], axial_stiffness=40.0)
    hold = torch.zeros(m.num_nodes, 3, dtype=torch.bool)
    hold[m.nodes_near_plane("x", 0.0), 0] = True
    hold[:, 1:] = True
    body = soft.SoftBody(
        m,
        dt=0.01,
        youngs_modulus=3000.0,
        poissons_ratio=0.0,
        gravity=(0.0, 0.0, 0.0),
        fixed=hold,
        muscles=[tendon.muscle],
        solver=soft.SolverOptions(**SHARP),
    )
    state = body.static_equilibrium(activation=tendon.activation(0.8)[None])
    bar = 3000.0 * 0.01
    expected = (bar + 40.0 * 0.8) / (bar + 40.0)
    end = state.x[m.nodes_near_plane("x", 1.0), 0].mean().item()
    if sections == 1:
        assert end == pytest.approx(expected, rel=1e-9)
        assert tendon.length(state.x).item() == pytest.approx(expected, rel=1e-9)
        tension = tendon.tension(state.x, 0.8)
        torch.testing.assert_close(tension, torch.full((10,), bar * (1 - expected)).double())
    else:  # free end: the axis is drawn in further than the rim, in the last section or two
        assert end == pytest.approx(expected, abs=0.02)
        assert tendon.length(state.x).item() < end


@pytest.mark.property
def test_stiffness_does_not_depend_on_the_mesh():
    """A cable in the axis shortens a bar alike in any mesh. A fiber of fixed w would pull 4 times
    less in the mesh of half the element size, and 6 times less in tetrahedra."""
    ends = []
    for m in (slender("hex", (10, 2, 2)), slender("hex", (20, 4, 4)), slender("tet", (10, 2, 2))):
        tendon = soft.Tendon(m, [[0, 0.05, 0.05], [1, 0.05, 0.05]], axial_stiffness=10.0)
        body = soft_body(
            m,
            youngs_modulus=3000.0,
            gravity=(0.0, 0.0, 0.0),
            fixed=m.nodes_near_plane("x", 0.0),
            muscles=[tendon.muscle],
        )
        state = body.static_equilibrium(activation=f64([0.9]))
        ends.append(1 - state.x[m.nodes_near_plane("x", 1.0), 0].mean().item())
    print(ends)
    assert max(ends) / min(ends) < 1.15
    assert ends[0] > 0.01


# weights of Muscle


@pytest.mark.reference
def test_weights_multiply_the_stiffness_of_fibers():
    """A weighted muscle is as many muscles of the weighted stiffness, driven alike."""
    m = irregular_mesh("tet")
    elements, weights = torch.tensor([0, 3, 5]), f64([0.5, 2.0, 3.0])
    one = soft.Muscle(elements=elements, direction=[1, 0.2, 0], stiffness=6.0, weights=weights)
    many = [
        soft.Muscle(elements=elements[k : k + 1], direction=[1, 0.2, 0], stiffness=6.0 * w)
        for k, w in enumerate(weights.tolist())
    ]
    x = deformed(m)
    together = soft_body(m, muscles=[one]).elastic_force(x, activation=f64([0.7]))
    apart = soft_body(m, muscles=many).elastic_force(x, activation=f64([0.7] * 3))
    torch.testing.assert_close(together, apart, rtol=1e-13, atol=1e-13)
    even = soft.Muscle(elements=elements, direction=[1, 0.2, 0], stiffness=6.0)
    assert even.weights.tolist() == [1.0, 1.0, 1.0]


@pytest.mark.reference
def test_weights_of_contraction_muscles():
    m = irregular_mesh("hex")
    x, r = deformed(m), f64([0.4])
    forces = [
        soft_body(
            m,
            muscles=[
                soft.Muscle(
                    elements=torch.tensor([0, 1]),
                    direction=[0, 1, 0.2],
                    stiffness=stiffness,
                    kind="contraction",
                    weights=weights,
                )
            ],
        ).elastic_force(x, activation=r)
        for stiffness, weights in ((6.0, None), (2.0, f64([3.0, 3.0])))
    ]
    torch.testing.assert_close(*forces, rtol=1e-13, atol=1e-13)


# words


def test_repr_copy_and_slack():
    m = slender("tet")
    tendon = soft.Tendon(m, [[0, 0.05, 0.05], [1, 0.05, 0.05]], axial_stiffness=3.0, slack=True)
    assert repr(tendon).startswith("Tendon(1 m in ") and repr(tendon).endswith("EA = 3 N)")
    twin = copy.deepcopy(tendon)
    assert twin.length(m.x_rest).item() == pytest.approx(1.0)
    assert tendon.slack
    assert tendon.activation(0.5).item() == pytest.approx(0.5)
    assert math.isclose(tendon.rest_length, 1.0)
    assert len(list(tendon.parameters())) == 0


@pytest.mark.parametrize(
    ("path", "stiffness", "error", "message"),
    [
        ([[0.1, 0.05, 0.05]], 1.0, ValueError, "path must have at least two corners, got 1"),
        ([[0.1, 0.05, 0.05]] * 2, 1.0, ValueError, "path must not repeat a corner"),
    ],
)
def test_bad_arguments(path, stiffness, error, message):
    with pytest.raises(error, match=message):
        soft.Tendon(slender("hex"), path, axial_stiffness=stiffness)


def test_bad_meshes_and_weights():
    with pytest.raises(TypeError, match="mesh must be a HexMesh or TetMesh, got str"):
        soft.Tendon("bar", [[0, 0, 0], [1, 0, 0]], axial_stiffness=1.0)
    one = {"elements": torch.tensor([0]), "direction": [1, 0, 0], "stiffness": 1.0}
    with pytest.raises(ValueError, match=r"weights must have shape \(1\), got \(2,\)"):
        soft.Muscle(**one, weights=torch.ones(2, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"weights must lie in .*got 0"):
        soft.Muscle(**one, weights=torch.zeros(1, dtype=torch.float64))
