"""Rest among obstacles: where motion ends, with its gradient in both modes, and what does not
settle."""

from dataclasses import replace

import pytest
import torch

from diffsim import contact, mesh, soft
from diffsim.core.errors import ConvergenceError
from tests.gradients import check_directions
from tests.soft.cases import leaf

UP = (0.07, 0.07, -0.017)


def bar(**changes) -> soft.SoftBody:
    """A bar that sags by 12 mm where nothing holds its tip."""
    box = mesh.hex_box((6, 2, 2), (0.1, 0.02, 0.02))
    return soft.SoftBody(
        box,
        dt=0.025,
        youngs_modulus=3e5,
        poissons_ratio=0.45,
        element="assumed_strain",
        fixed=box.nodes_near_plane("x", 0.0),
        **changes,
    )


def peg(friction=0.0, position=(0.0, 0.0, 0.0)) -> contact.Obstacle:
    """Below the bar, across it."""
    made = contact.capsule((0.07, -0.05, -0.017), UP, 0.015, friction=friction)
    return replace(made, position=torch.as_tensor(position).double())


@pytest.mark.parametrize("obstacle", [contact.floor(-0.002), peg(), [peg(), contact.floor(-0.004)]])
def test_it_is_where_a_damped_motion_ends(obstacle):
    solver = soft.SolverOptions(rtol=1e-9)
    damped = bar(damping=soft.Damping(rayleigh_alpha=30.0), solver=solver)
    end = soft.rollout(damped, damped.rest_state(), 150, obstacles=obstacle).final
    rest = bar(solver=solver).static_equilibrium(obstacles=obstacle)
    torch.testing.assert_close(rest.x, end.x, rtol=0, atol=1e-9)
    torch.testing.assert_close(rest.contact_force, end.contact_force, rtol=0, atol=1e-6)
    assert rest.contact_force[:, 2].sum() > 0.1
    assert not rest.v.any()


@pytest.mark.grad
def test_gradients_see_curved_surfaces_friction_and_the_last_equilibrium():
    """Two equilibria, one after another: the peg moves up and along between them."""
    body = bar(solver=soft.SolverOptions(rtol=1e-10))
    moving = {"velocity": torch.tensor([0.02, 0.0, 0.04]).double()}

    def rest(modulus, friction, position, shape):
        moved = body.mesh.x_rest + 0.03 * shape
        physics = body.physics(youngs_modulus=3e5 * modulus, x_rest=moved)
        obstacle = replace(peg(friction, 0.1 * position), **moving)
        first = body.static_equilibrium(obstacles=obstacle, physics=physics)
        obstacle = obstacle.after(body.dt)
        state = body.static_equilibrium(obstacles=obstacle, guess=first.x, physics=physics)
        return 10.0 * state.x, state.contact_force

    args = [1.0, 0.3, [0.0, 0.0, 0.0], torch.zeros_like(body.mesh.x_rest)]
    check_directions(
        rest, [leaf(a) for a in args], eps=3e-5, rtol=1e-6, atol=1e-6, check_forward_ad=True
    )


def test_members_of_a_batch_and_linearly_implicit_bodies():
    moduli = torch.tensor([2e5, 3e5, 5e5]).double()
    body = bar(solver=soft.SolverOptions(rtol=1e-9, method="linearly_implicit"))
    iterated = bar(solver=soft.SolverOptions(rtol=1e-9))
    physics, start = body.physics(batch=3, youngs_modulus=moduli), body.mesh.x_rest
    many = body.static_equilibrium(
        obstacles=peg(0.5), guess=start.expand(3, -1, -1), physics=physics
    )
    floor = contact.floor(-0.002, friction=0.3)

    def on_floor(modulus):
        own = iterated.physics(youngs_modulus=modulus)
        return iterated.static_equilibrium(obstacles=floor, physics=own).x

    mapped = torch.func.vmap(on_floor)(moduli)
    for k, modulus in enumerate(moduli):
        own = iterated.physics(youngs_modulus=modulus)
        one = iterated.static_equilibrium(obstacles=peg(0.5), physics=own)
        torch.testing.assert_close(many.x[k], one.x, rtol=0, atol=1e-9)
        torch.testing.assert_close(mapped[k], on_floor(modulus), rtol=0, atol=1e-12)


def test_what_does_not_settle_says_so(monkeypatch):
    monkeypatch.setattr(soft.statics, "_MOST_ROUNDS", 1)
    with pytest.raises(ConvergenceError, match=r"did not settle in 1 equilibria.*guess"):
        bar().static_equilibrium(obstacles=peg())
