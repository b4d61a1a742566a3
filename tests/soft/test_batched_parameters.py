"""One set of parameters for each member of a batch: a loop over members, in one call."""

import math

import pytest
import torch
from torch import Tensor

from diffsim import contact, mesh, soft
from tests.soft.cases import SHARP, irregular_mesh, leaf, noise, rail_mask, soft_body, two_muscles

MEMBERS = 3


def bar(method: str = "auto", **changes) -> soft.SoftBody:
    m = irregular_mesh("hex", cells=(3, 1, 1))
    return soft_body(
        m,
        fixed=rail_mask(m),
        muscles=two_muscles()[:1],
        rayleigh_beta=0.02,
        solver=soft.SolverOptions(method=method, **SHARP),
        **changes,
    )


def members(body: soft.SoftBody) -> dict[str, Tensor]:
    """Every parameter, different for each member; stiffness and damping by element too."""
    elements, nodes = body.mesh.num_elements, body.mesh.num_nodes

    def around(value: float, *shape: int, seed: int) -> Tensor:
        return value * (1.0 + 0.2 * noise(MEMBERS, *shape, seed=seed).clamp(-1.5, 1.5))

    return {
        "youngs_modulus": around(30.0, elements, seed=1),
        "poissons_ratio": around(0.3, 1, seed=2),
        "density": around(1.5, 1, seed=3),
        "gravity": noise(MEMBERS, 3, seed=4),
        "rayleigh_alpha": around(0.1, seed=5),
        "rayleigh_beta": around(0.02, elements, seed=6),
        "attached_mass": around(0.05, nodes, seed=7),
        "added_mass": around(0.03, nodes, seed=8),
        "fiber_stiffness": around(8.0, 1, seed=9),
    }


def start(body: soft.SoftBody) -> soft.State:
    shape = (MEMBERS, *body.x_rest.shape)
    return soft.State(body.x_rest + 0.05 * noise(*shape, seed=10), 0.3 * noise(*shape, seed=11))


def of_member(values: dict[str, Tensor], k: int) -> dict[str, Tensor]:
    """Member k's parameters, as a body without a batch takes them."""
    one = {n: v[k] for n, v in values.items()}
    for name in ("poissons_ratio", "density"):
        one[name] = one[name][0]
    return one


INTEGRATORS = ("implicit_euler", "bdf2", "implicit_midpoint", "semi_implicit_euler")


@pytest.mark.parametrize("method", ["auto", "linearly_implicit", "newton_pcg"])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_rollout_is_that_of_a_loop_over_members(integrator, method):
    dt = 0.005 if integrator == "semi_implicit_euler" else 0.1
    body = bar(method, integrator=integrator, dt=dt)
    values = {n: leaf(v) for n, v in members(body).items()}
    state = start(body)
    weight = noise(*state.x.shape, seed=12)
    physics = body.physics(batch=MEMBERS, **values)
    many = soft.rollout(body, state, 3, physics=physics).x[-1]
    grads = torch.autograd.grad((weight * many).sum(), list(values.values()))
    for k in range(MEMBERS):
        own = body.physics(**of_member(values, k))
        one = soft.rollout(body, soft.State(state.x[k], state.v[k]), 3, physics=own).x[-1]
        # Preconditioners are made of the mean parameters: equal within the tolerance of 1e-12.
        torch.testing.assert_close(many[k], one, rtol=0, atol=1e-10)
        own_grads = torch.autograd.grad((weight[k] * one).sum(), list(values.values()))
        for all_of_them, a in zip(grads, own_grads, strict=True):
            scale = float(all_of_them[k].abs().max()) + 1e-3
            torch.testing.assert_close(all_of_them[k], a[k], rtol=0, atol=1e-7 * scale)


def test_statics_and_forces_take_members_too():
    m = mesh.hex_box((4, 1, 1), (3.0, 1.0, 1.0))
    solver = soft.SolverOptions(rtol=1e-10)
    body = soft_body(m, fixed=m.nodes_near_plane("x", 0.0), solver=solver)
    E = leaf([500.0, 1000.0, 4000.0])
    physics = body.physics(batch=3, youngs_modulus=E)
    at = m.x_rest.expand(3, -1, -1)
    down = body.static_equilibrium(guess=at, physics=physics).x
    x = m.x_rest + 0.05 * noise(3, m.num_nodes, 3, seed=1)
    force = soft.elastic_force(body, x, physics=physics)
    for k in range(3):
        own = body.physics(youngs_modulus=E[k])
        torch.testing.assert_close(
            down[k], body.static_equilibrium(physics=own).x, rtol=0, atol=1e-8
        )
        assert torch.equal(force[k], soft.elastic_force(body, x[k], physics=own))
    modulus = leaf([500.0, 1000.0, 4000.0])
    energy = soft.elastic_energy(body, x, physics=body.physics(batch=3, youngs_modulus=modulus))
    (slope,) = torch.autograd.grad(energy.sum(), modulus)  # linear in each member's own modulus
    torch.testing.assert_close(slope * modulus, energy, rtol=1e-12, atol=0)
    sag = down[:, -1, 2]
    (slope,) = torch.autograd.grad(sag.sum(), E)
    assert bool((slope > 0).all())
    assert bool((slope.diff() < 0).all())  # the softest member gains most


def test_friction_and_restitution_of_members():
    m = mesh.hex_box((2, 2, 2), (1.0, 1.0, 1.0))
    body = soft_body(m, dt=0.01, youngs_modulus=1000.0, gravity=(0.0, 0.0, -10.0))
    friction, bounce = leaf([0.0, 0.2, math.inf, 0.4]), leaf([0.0, 0.5, 0.0, 0.2])
    v = torch.tensor([1.0, 0.0, -0.5], dtype=torch.float64).expand(4, m.num_nodes, 3)
    x = m.x_rest.expand(4, -1, -1)

    def end(x, v, mu, e):
        floor = contact.floor(-1e-4, friction=mu, restitution=e)
        return soft.rollout(body, soft.State(x, v), 5, obstacles=floor).x[-1]

    many = end(x, v, friction, bounce)
    finite = torch.tensor([0, 1, 3])
    grads = torch.autograd.grad(many[:, :, 0].sum(), (friction, bounce))
    for k in range(4):
        mu, e = leaf(friction[k].detach()), leaf(bounce[k].detach())
        one = end(x[k], v[k], mu, e)
        torch.testing.assert_close(many[k], one, rtol=0, atol=1e-10)
        own = torch.autograd.grad(one[:, 0].sum(), (mu, e))
        if k in finite:
            assert float(grads[0][k]) == pytest.approx(float(own[0]), rel=1e-6, abs=1e-9)
            assert float(grads[1][k]) == pytest.approx(float(own[1]), rel=1e-6, abs=1e-9)
    slid = (many - x)[..., 0].mean(1)
    assert bool(slid[0] > slid[1])


def test_wrong_shapes_say_what_is_expected():
    body = bar()
    with pytest.raises(ValueError, match=r"for a batch of 3 members \(3,\) or \(3, num_elements\)"):
        body.physics(batch=3, youngs_modulus=torch.ones(7, dtype=torch.float64))
    with pytest.raises(ValueError, match="scalar or have shape"):
        body.physics(youngs_modulus=torch.ones(2, 2, dtype=torch.float64))
    with pytest.raises(ValueError, match="density of members"):
        body.physics(batch=5, density=torch.ones(5, 2, dtype=torch.float64))
    physics = body.physics(batch=5, youngs_modulus=torch.linspace(20, 40, 5, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"begin with body.rest_state\(batch=5\)"):
        body(body.rest_state(), physics=physics)
    body(body.rest_state(batch=5), physics=physics)
    own = body.mesh.num_elements
    with pytest.raises(ValueError, match="of members or of elements"):
        body.physics(batch=own, youngs_modulus=torch.ones(own, dtype=torch.float64))
    floor = contact.floor(-9.0, friction=torch.tensor([0.1, 0.2], dtype=torch.float64))
    free = soft_body(irregular_mesh("hex"))
    with pytest.raises(ValueError, match="given for 2 members"):
        free(free.rest_state(batch=5), obstacles=floor)


def test_contraction_muscles_may_differ_where_parameters_do():
    m = irregular_mesh("hex")
    body = soft_body(m, muscles=two_muscles()[1:])
    r = leaf([[0.0], [0.3]])
    many = body(body.rest_state(batch=2), activation=r, physics=body.physics(batch=2)).x
    for k in range(2):
        one = body(body.rest_state(), activation=r[k]).x
        torch.testing.assert_close(many[k], one, rtol=0, atol=1e-10)
