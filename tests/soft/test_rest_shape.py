"""The gradient of the rest shape: energies, steps, rollouts, statics, contact, in both modes."""

import pytest
import torch

from diffsim import contact, mesh, soft
from tests.covering import covering
from tests.gradients import check_directions
from tests.soft.cases import (
    KINDS,
    SHARP,
    deformed,
    element_of,
    irregular_mesh,
    leaf,
    noise,
    rail_mask,
    soft_body,
    two_muscles,
)

INTEGRATORS = ["implicit_euler", "bdf2", "implicit_midpoint", "semi_implicit_euler"]
# Differences over 1e-5 of entries of order one, third derivatives of order ten, and a solver that
# stops at 1e-12: 1e-9.
TOLERANCE = {"eps": 1e-5, "rtol": 1e-6, "atol": 1e-7, "check_forward_ad": True}
ACTIVATION = torch.tensor([0.8, 0.3, 0.7], dtype=torch.float64)
METHODS = ["auto", "linearly_implicit"]


def muscles_and_tendon(m) -> list[soft.Muscle]:
    """Muscles of two kinds, and a cable with a corner."""
    path = [[0.4, 0.4, 0.4], [1.0, 0.6, 0.5], [1.6, 0.5, 0.6]]
    return [*two_muscles(), soft.Tendon(m, path, axial_stiffness=5.0).muscle]


def by_method(method: str) -> soft.SolverOptions:
    return soft.SolverOptions(method=method, **SHARP)


def mesh_and_shape(kind: str):
    """A mesh, the rest positions that may be chosen, and those of all its nodes as their function:
    midpoints of quadratic elements stay in the middle."""
    if kind != "quadratic":
        m = irregular_mesh(kind, (2, 1, 1))
        return m, m.x_rest, lambda x: x
    coarse = irregular_mesh("tet", (1, 1, 1))
    return mesh.split_tets(coarse), coarse.x_rest, lambda x: mesh.split_positions(coarse, x)


def held_end(m) -> torch.Tensor:
    """Nodes at the end of least x."""
    return m.x_rest[:, 0] < 0.3


@pytest.mark.grad
@covering(integrator=INTEGRATORS, kind=KINDS, method=METHODS, material=soft.MATERIALS)
def test_rollout(integrator, kind, method, material):
    """Damping, muscles, a tendon, weight and rails over three steps: masses, the tendon's pieces
    and targets follow the shape."""
    m, x_rest, place = mesh_and_shape(kind)
    body = soft_body(
        m,
        element=element_of(kind),
        integrator=integrator,
        material=material,
        muscles=muscles_and_tendon(m),
        solver=by_method(method),
        rayleigh_alpha=0.3,
        rayleigh_beta=0.02,
        fixed=rail_mask(m),
        dt=0.02 if integrator == "semi_implicit_euler" else 0.1,
    )

    def end(x, v):
        physics = body.physics(x_rest=place(x))
        state = body.rest_state(physics=physics)._replace(v=v)
        for _ in range(3):
            state = soft.step(body, state, activation=ACTIVATION, physics=physics)
        return state.x, 0.1 * state.v

    check_directions(end, (leaf(x_rest), leaf(0.3 * noise(m.num_nodes, 3, seed=2))), **TOLERANCE)


@pytest.mark.grad
@covering(kind=KINDS, material=soft.MATERIALS)
def test_energy_force_and_rest_under_load(kind, material):
    """A rigid motion of the rest shape alone does no work: no material here has an axis."""
    m, x_rest, place = mesh_and_shape(kind)
    muscles = muscles_and_tendon(m)
    body = soft_body(
        m, material=material, element=element_of(kind), fixed=held_end(m), muscles=muscles
    )
    x, shape = deformed(m, 0.1), leaf(x_rest)

    def energy_and_force(shape):
        given = {"physics": body.physics(x_rest=place(shape)), "activation": ACTIVATION}
        return body.elastic_energy(x, **given), body.elastic_force(x, **given)

    check_directions(energy_and_force, (shape,), **TOLERANCE)
    energy, force = energy_and_force(shape)
    (grad,) = torch.autograd.grad(energy + (force * noise(*force.shape)).sum(), shape)
    scale = 1e-12 * float(grad.abs().sum())
    assert grad.sum(0).abs().max() < scale
    assert torch.linalg.cross(shape.detach(), grad, dim=1).sum(0).abs().max() < scale

    def at_rest(shape):
        return soft.static_equilibrium(body, physics=body.physics(x_rest=place(shape))).x

    check_directions(at_rest, (shape,), **TOLERANCE)


@pytest.mark.grad
@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_contact_and_chambers(kind):
    """Landing with friction, and a body that is blown up."""
    m, x_rest, place = mesh_and_shape(kind)
    body = soft_body(m, rayleigh_beta=0.02)
    floor = contact.floor(float(m.x_rest[:, 2].min()) - 0.01, friction=0.3)

    def landed(x):
        physics = body.physics(x_rest=place(x))
        v = torch.tensor([0.5, 0.0, -1.0], dtype=torch.float64).expand(m.num_nodes, 3)
        state = body.rest_state(physics=physics)._replace(v=v)
        for _ in range(3):
            state = soft.step(body, state, obstacles=floor, physics=physics)
        assert state.contact_force.any()
        return state.x, state.contact_force

    check_directions(landed, (leaf(x_rest),), **TOLERANCE)
    chamber = soft.PressureChamber(mesh.surface_triangles(m).faces)
    blown = soft_body(m, chambers=[chamber], fixed=held_end(m))
    pressure = torch.tensor([2.0], dtype=torch.float64)

    def at_rest(x):
        physics = blown.physics(x_rest=place(x))
        return soft.static_equilibrium(blown, pressure=pressure, physics=physics).x

    check_directions(at_rest, (leaf(x_rest),), **TOLERANCE)


@pytest.mark.parametrize("kind", KINDS)
def test_a_moved_shape_is_a_body_of_that_shape(kind):
    """No factor of another shape serves; members of torch.func.vmap have shapes of their own."""
    m, x_rest, place = mesh_and_shape(kind)
    body = soft_body(m, element=element_of(kind), fixed=held_end(m))
    shapes = torch.stack([x_rest + 0.05 * noise(*x_rest.shape, seed=k) for k in range(2)])

    def sag(x):
        return soft.static_equilibrium(body, physics=body.physics(x_rest=place(x))).x

    for x, mapped in zip(shapes, torch.func.vmap(sag)(shapes), strict=True):
        other = soft_body(type(m)(place(x), m.elements), element=body.element, fixed=held_end(m))
        torch.testing.assert_close(sag(x), soft.static_equilibrium(other).x, rtol=1e-11, atol=1e-11)
        torch.testing.assert_close(mapped, sag(x), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_a_tendon_is_that_of_its_shape(kind):
    """Of a shape that an affine map gives, it is the cable along the mapped path."""
    m = irregular_mesh(kind, (2, 1, 1))
    path = torch.tensor([[0.4, 0.4, 0.4], [1.0, 0.6, 0.5], [1.6, 0.5, 0.6]], dtype=torch.float64)
    affine = torch.eye(3, dtype=torch.float64) + 0.3 * noise(3, 3, seed=5)
    old = soft.Tendon(m, path, axial_stiffness=5.0)
    body = soft_body(m, muscles=[old.muscle], fixed=held_end(m))
    physics = body.physics(x_rest=m.x_rest @ affine)
    moved = type(m)(m.x_rest @ affine, m.elements)
    new = soft.Tendon(moved, path @ affine, axial_stiffness=5.0)
    other = soft_body(moved, muscles=[new.muscle], fixed=held_end(m))
    command = 0.8 * new.rest_length
    found = body.static_equilibrium(
        activation=old.activation(command, moved.x_rest)[None], physics=physics
    )
    wanted = other.static_equilibrium(activation=new.activation(command)[None])
    torch.testing.assert_close(found.x, wanted.x, rtol=1e-9, atol=1e-9)
    ours = old.tension(found.x, 0.8, x_rest=moved.x_rest)
    theirs = new.tension(wanted.x, 0.8)
    assert theirs.max() > 0.1
    torch.testing.assert_close(ours.sort().values, theirs.sort().values, rtol=1e-9, atol=1e-9)


@covering(kind=KINDS, method=METHODS)
def test_many_directions_at_once(kind, method):
    """rollout_tangents against torch.func.jvp; a default target moves with the shape."""
    m, x_rest, place = mesh_and_shape(kind)
    body = soft_body(
        m,
        element=element_of(kind),
        fixed=held_end(m),
        muscles=muscles_and_tendon(m),
        solver=by_method(method),
        rayleigh_beta=0.02,
        integrator="bdf2",
    )
    given = {"activation": ACTIVATION}

    def end(x):
        physics = body.physics(x_rest=place(x))
        start = body.rest_state(physics=physics)
        return soft.rollout(body, start, 4, physics=physics, **given).x[-1]

    moved = noise(2, *x_rest.shape, seed=3)
    value, rates = {"x_rest": place(x_rest)}, {"x_rest": torch.stack([place(d) for d in moved])}
    directions = soft.Directions(
        physics=soft.physics_directions(body, value, rates), x=rates["x_rest"]
    )
    physics = body.physics(**value)
    found = soft.rollout_tangents(
        body, body.rest_state(), 4, 2, directions, physics=physics, **given
    )
    for tangent, direction in zip(found.tangent[-1], moved, strict=True):
        expected = torch.func.jvp(end, (x_rest,), (direction,))[1]
        torch.testing.assert_close(tangent, expected, rtol=1e-9, atol=1e-9)


def test_refusals():
    m = mesh.hex_box((2, 1, 1), (2.0, 1.0, 1.0))
    body = soft_body(m)
    inverted = m.x_rest.clone()
    inverted[0, 0] = 1.5
    with pytest.raises(ValueError, match="x_rest makes no mesh: 1 of 2 elements"):
        body.physics(x_rest=inverted)
    with pytest.raises(ValueError, match=r"x_rest cannot be given with batch.*vmap"):
        body.physics(x_rest=m.x_rest, batch=2)
    split = mesh.split_tets(irregular_mesh("tet", (1, 1, 1)))
    bent = split.x_rest.clone()
    bent[-1] += 0.02
    with pytest.raises(ValueError, match="is not made of tetrahedra split in eight"):
        soft_body(split, element="quadratic").physics(x_rest=bent)


def test_the_mesh_is_not_marked():
    m = mesh.hex_box((1, 1, 1))
    soft_body(m).x_rest.requires_grad_()
    assert not m.x_rest.requires_grad
