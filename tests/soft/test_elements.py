"""Elements by what they must do whatever their inside: rigid motions, patches, beams and rings."""

import numpy as np
import pytest
import torch

from diffsim import contact, mesh, soft
from diffsim.core.errors import MeshError
from tests.soft.cases import irregular_mesh, noise, soft_body

ELEMENT = {"element": "assumed_strain"}


@pytest.mark.property
@pytest.mark.parametrize("kind", ["assumed_strain", "quadratic"])
def test_patch_of_distorted_elements(kind):
    """A large affine deformation leaves inner nodes in equilibrium, with the solid's own energy."""
    m = irregular_mesh(kind, (3, 3, 3), (1.0, 1.0, 1.0), amount=0.04)
    stretch = torch.tensor(
        [[1.3, 0.2, 0.0], [-0.1, 0.9, 0.2], [0.0, 0.1, 0.8]], dtype=torch.float64
    )
    x = m.x_rest @ stretch.T
    inner = torch.ones(m.num_nodes, dtype=torch.bool)
    inner[mesh.surface_vertices(m)] = False
    standard = soft_body(m, material="neo_hookean")
    body = soft_body(m, material="neo_hookean", element=kind)
    force = body.elastic_force(x)
    assert int(inner.sum()) >= 8
    assert force[inner].abs().max() < 1e-13 * force.abs().max()
    torch.testing.assert_close(body.elastic_energy(x), standard.elastic_energy(x))


@pytest.mark.property
def test_only_rigid_motions_cost_nothing():
    """The stiffness of one distorted element at rest: six zeros, all else well above: 3e-4 of the
    largest is how an element three times as long as high bends where nu is 0.49."""
    brick = irregular_mesh("hex", (1, 1, 1), (1.0, 0.6, 0.3), amount=0.03)
    corners = torch.tensor([[0, 0, 0], [1, 0.1, 0], [0.2, 0.6, 0], [0.1, 0.2, 0.4]]).double()
    tet = mesh.split_tets(mesh.TetMesh(corners, torch.arange(4)[None]))
    for m, element in ((brick, "assumed_strain"), (tet, "quadratic")):
        for nu in (0.0, 0.3, 0.49):
            body = soft_body(m, poissons_ratio=nu, element=element)
            rows = torch.autograd.functional.jacobian(body.elastic_force, m.x_rest.clone())
            values = torch.linalg.eigvalsh(-rows.reshape(m.num_dofs, m.num_dofs))
            assert values[:6].abs().max() < 1e-12 * values[-1]
            assert values[6] > 1e-4 * values[-1]


def box(element, cells, size, origin):
    """A box with the nodes of ``cells``."""
    if element != "quadratic":
        return mesh.hex_box(cells, size, origin)
    half = [n // 2 for n in cells]
    return mesh.split_tets(mesh.tet_box(half, size, origin, symmetric=True))


def tip_share(cells, nu, *, element, clamped=False, size=(1.0, 0.1, 0.1)) -> tuple[float, float]:
    """Deflection of a beam under a tip load by Timoshenko's, and sideways by deflection [-].

    The end is held as beam theory has it, free to contract about its middle, or clamped.
    """
    modulus, deflection = 21e9, 1e-3
    length, width, height = size
    bending = length**3 / (3.0 * modulus * width * height**3 / 12.0)
    shear = length / (5.0 / 6.0 * modulus / (2.0 * (1.0 + nu)) * width * height)
    load = deflection / (bending + shear)
    m = box(element, cells, size, (0.0, -width / 2, -height / 2))
    end = m.nodes_near_plane("x", 0.0)
    fixed = torch.zeros(m.num_nodes, 3, dtype=torch.bool)
    fixed[end, 0] = True
    y, z = m.x_rest[end, 1].abs(), m.x_rest[end, 2].abs()
    fixed[end[y < 1e-9], 1] = True
    fixed[end[z < 1e-9], 2] = True
    if clamped:
        fixed[end] = True
    tip = m.nodes_near_plane("x", length)
    share = torch.ones(len(tip), dtype=torch.float64)
    for axis, half in ((1, width / 2), (2, height / 2)):
        share[(m.x_rest[tip, axis].abs() - half).abs() < 1e-9] *= 0.5
    force = torch.zeros_like(m.x_rest)
    force[tip, 2] = load * share / share.sum()
    body = soft.SoftBody(
        m, dt=0.01, youngs_modulus=modulus, poissons_ratio=nu, gravity=(0.0, 0.0, 0.0),
        fixed=fixed, element=element,
    )  # fmt: skip
    moved = (body.static_equilibrium(external_force=force).x - m.x_rest)[tip].mean(0)
    return float(moved[2]) / deflection, float((moved[1] / moved[2]).abs())


@pytest.mark.reference
@pytest.mark.parametrize("nu", [0.0, 0.3, 0.49])
def test_beam_bends_as_beam_theory_says(nu):
    """Within 1 % on two or four cells through the height; clamped, a beam is stiffer by itself:
    by 2.0 % at nu 0.49 where cells are refined towards the clamp."""
    for element, cells in (
        ("assumed_strain", (10, 2, 2)),
        ("assumed_strain", (20, 4, 4)),
        ("quadratic", (20, 4, 4)),
    ):
        share, sideways = tip_share(cells, nu, element=element)
        assert 0.99 < share < 1.001
        assert sideways < 1e-6
    assert 0.95 < tip_share((20, 4, 4), nu, element="assumed_strain", clamped=True)[0] < 1.0
    assert tip_share((20, 4, 4), nu, element="standard")[0] < 0.92


@pytest.mark.order
def test_beam_converges_with_the_second_power_of_the_cells():
    errors = [1.0 - tip_share((5 * n, 2, 2 * n), 0.3, element="assumed_strain")[0] for n in (1, 2)]
    coarse = 1.0 - tip_share((5, 2, 2), 0.3, element="assumed_strain")[0]
    assert coarse == errors[0]
    assert np.log2(errors[0] / errors[1]) > 1.7


@pytest.mark.property
def test_contact_explicit_steps_and_threads():
    """What does not ask for the element's kind takes it: obstacles, explicit steps, threads."""
    box = mesh.hex_box((6, 3, 3), (2.0, 1.0, 1.0), (0.0, 0.0, 0.02))
    floor = contact.Obstacle(contact.Plane((0.0, 0.0, 1.0)), friction=0.3)
    ends = []
    for threads in (1, 2):
        solver = soft.SolverOptions(rtol=1e-10, num_threads=threads)
        body = soft_body(box, dt=0.02, solver=solver, **ELEMENT)
        ends.append(soft.rollout(body, body.rest_state(), 10, obstacles=floor).x[-1])
    torch.testing.assert_close(ends[0], ends[1], rtol=0, atol=1e-9)
    assert ends[0][:, 2].min() > -1e-9
    explicit = soft_body(box, dt=1e-3, integrator="semi_implicit_euler", **ELEMENT)
    implicit = soft_body(box, dt=1e-3, integrator="implicit_midpoint", **ELEMENT)
    start = soft.State(box.x_rest, 0.3 * noise(box.num_nodes, 3))
    one, other = (soft.rollout(b, start, 20).x[-1] for b in (explicit, implicit))
    torch.testing.assert_close(one, other, rtol=0, atol=2e-3)


def test_names_are_checked():
    with pytest.raises(ValueError, match="element must be one of"):
        soft_body(mesh.hex_box((1, 1, 1)), element="cubic")
    with pytest.raises(ValueError, match="needs a HexMesh"):
        soft_body(mesh.tet_box((1, 1, 1)), **ELEMENT)
    with pytest.raises(ValueError, match="needs a TetMesh"):
        soft_body(mesh.hex_box((1, 1, 1)), element="quadratic")
    with pytest.raises(MeshError, match=r"6 tetrahedra is not made of .*mesh\.split_tets"):
        soft_body(mesh.tet_box((1, 1, 1)), element="quadratic")
    with pytest.raises(MeshError, match="elements from 0 on"):
        soft_body(mesh.tet_box((2, 2, 1)), element="quadratic")
    body = soft_body(mesh.hex_box((1, 1, 1)), **ELEMENT)
    other = soft_body(mesh.hex_box((1, 1, 1)))
    with pytest.raises(ValueError, match="weights"):
        body(body.rest_state(), physics=other.physics())
    assert "assumed_strain" in repr(body)
