"""Lists and NumPy arrays where a newcomer has them; what would be rounded or lost is refused."""

import numpy as np
import pytest
import torch

from diffsim import contact, copter, mesh, soft

BAR = mesh.hex_box((3, 1, 1))


@pytest.mark.parametrize("form", [np.asarray, lambda a: np.asarray(a).tolist()])
def test_constructors_take_lists_and_arrays(form, tmp_path):
    own = mesh.HexMesh(form(BAR.x_rest), form(BAR.hexes))
    assert torch.equal(own.nodes, BAR.x_rest) and torch.equal(own.hexes, BAR.hexes)
    tet = mesh.TetMesh(form([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), form([[0, 1, 2, 3]]))
    assert tet.num_nodes == tet.num_vertices == 4
    assert own.nodes_where(lambda x: form(x[:, 0] < 0.1)).tolist() == [0, 1, 2, 3]

    def held(fixed, nodes):
        options = soft.ContactOptions(contact_nodes=nodes)
        return soft.SoftBody(
            own,
            dt=0.01,
            youngs_modulus=form(np.full(3, 1e5)),
            poissons_ratio=0.3,
            fixed=fixed,
            contact=options,
        ).fixed

    mask = held(form([0, 1]), form([9, 10]))
    assert mask.any(1).nonzero().flatten().tolist() == [0, 1]
    assert torch.equal(held(form(mask), form([9])), mask)
    assert torch.equal(held(form(mask.any(1)), form([9])), mask)
    muscle = soft.Muscle(elements=form([0, 1]), direction=form([1.0, 0, 0]), stiffness=1e4)
    assert muscle.direction.shape == (2, 3)
    plane = contact.Plane(form([0, 0, 2]), 0.5)
    assert plane.normal.tolist() == [0.0, 0.0, 1.0]
    path = mesh.save(own, tmp_path / "a.vtu", x=form(2 * BAR.x_rest))
    assert torch.equal(mesh.load(path).x_rest, 2 * BAR.x_rest)


@pytest.mark.parametrize("form", [np.asarray, lambda a: np.asarray(a).tolist()])
def test_a_multicopter_of_plain_numbers(form):
    arms = [[0.1, 0.1, 0], [-0.1, 0.1, 0], [-0.1, -0.1, 0], [0.1, -0.1, 0]]
    quad = copter.Multicopter(
        mass=1,
        inertia=form(np.diag([0.01, 0.01, 0.02])),
        positions=form(arms),
        directions=form([[0, 0, -1]] * 4),
        spins=form([1, -1, 1, -1]),
        torque_ratios=form([0.01] * 4),
        max_thrusts=form([6.0] * 4),
        radii=form([0.1] * 4),
    )
    assert float(copter.hover(quad).thrusts.sum()) == pytest.approx(9.81)


@pytest.mark.parametrize(
    ("hexes", "words"),
    [
        (BAR.hexes.double().tolist(), "hexes must be an array of numbers.*not whole numbers"),
        ([[0, 1], [2]], "hexes must be an array of numbers"),
        ([*BAR.hexes], r"hexes must be .* list with tensors in it; join them with torch.stack"),
        ("part.vtu", "hexes must be an array of numbers, got 'part.vtu'"),
        (np.zeros((3, 8), bool), "entries are of type bool, not whole numbers"),
    ],
)
def test_nothing_is_rounded_or_cut_off(hexes, words):
    with pytest.raises(TypeError, match=words):
        mesh.HexMesh(BAR.x_rest, hexes)


def test_own_memory_and_any_byte_order():
    given = BAR.x_rest.numpy().astype(">f8")
    own = mesh.HexMesh(given, BAR.hexes)
    given[:] = 7.0
    assert torch.equal(own.nodes, BAR.x_rest)


def test_steps_take_tensors_alone_and_say_how():
    body = soft.SoftBody(BAR, dt=0.01, youngs_modulus=1e5, poissons_ratio=0.3)
    with pytest.raises(TypeError, match=r"got list; convert with torch.as_tensor\(external_force"):
        body(body.rest_state(), external_force=[[0.0, 0.0, 0.0]])
