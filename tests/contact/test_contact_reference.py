"""Reference vectors of ../shared/data/soft_reference: a tilted cube dropped on a plane.

The reference holds active nodes at their old places, wherever those are (section 4 of its README),
with forces that push; the vectors' own active sets are imposed first: there the answer is unique.
"""

import math

import pytest
import torch

from diffsim import contact, soft
from diffsim.soft import _ops_contact
from diffsim.soft._arrays import ContactArrays, StepArrays
from diffsim.soft.integrators import make_stage
from tests.contact.scenes import violations
from tests.soft.test_reference import close, load, make_mesh, reference_mass

pytestmark = pytest.mark.reference

SOLVER = soft.SolverOptions(method="newton_cholesky", rtol=1e-12, adjoint_rtol=1e-12)


@pytest.fixture(scope="module")
def data():
    return load("hex_dropped_cube")


@pytest.fixture(scope="module")
def body(data):
    m = make_mesh("hex", data)
    return soft.SoftBody(
        m,
        dt=float(data["h"]),
        youngs_modulus=float(data["E"]),
        poissons_ratio=float(data["nu"]),
        masses=soft.Masses(node_mass=reference_mass(m, data)),
        material=soft.Material(volume_weight="thesis"),
        contact=soft.ContactOptions(contact_nodes=data["candidates"]),
        solver=SOLVER,
    )


def plane_of(data):
    normal, offset = data["boundary"][:3], data["boundary"][3]
    return normal / normal.norm(), float(offset / normal.norm())


def held_step(body, data, state, active, physics):
    """One step with the nodes in ``active`` held where they are, at the level of the op.

    A half space through the old place with infinite friction holds a node that is pressed; the
    others get their true gap, of which the kernel must find that it stays open.
    """
    normal, shift = plane_of(data)
    nodes = body.contact_nodes
    reference = state.x[nodes]
    gap = -(reference @ normal) - shift
    offset = torch.where(active[nodes], 0.0, gap)
    stage = make_stage("implicit_euler", body.dt, state)
    empty = torch.zeros(0, dtype=torch.float64)
    none = torch.zeros(1, 0, dtype=torch.float64)
    inputs = StepArrays(
        y=stage.y[None],
        force=(physics.weighing_mass[:, None] * physics.gravity)[None],
        target=body.x_rest[None],
        guess=state.x.detach()[None],
        inertia=stage.rates.c * physics.mass,
        weights=physics.weights,
        fiber_stiffness=empty,
        activation=none,
        damp_mu=empty,
        damp_lambda=empty,
        x_frame=empty,
        x_velocity=empty,
        pressure=none,
        tables=empty,
    )
    guess = torch.where(active[nodes][:, None], 1.0, 0.0) * normal
    contacts = ContactArrays(
        normal=normal.expand(len(nodes), 3).contiguous()[None],
        reference=reference[None],
        offset=offset[None],
        friction=torch.full((1, len(nodes)), math.inf, dtype=torch.float64),
        force_guess=guess[None],
    )
    x, _, status, _ = _ops_contact.contact_step(
        *inputs.tensors(),
        *contacts.tensors(),
        nodes,
        handle=body.handle,
        cache_columns=True,
        **body.solver.arguments(),
    )
    assert torch.equal(status[0] > 0, active[nodes])
    return soft.State(x[0], (x[0] - state.x) / body.dt)


@pytest.mark.parametrize("num_steps", [20, 60])
def test_states_and_gradients_with_the_stored_contact_sets(data, body, num_steps):
    youngs = torch.tensor(float(data["E"]), dtype=torch.float64, requires_grad=True)
    poisson = torch.tensor(float(data["nu"]), dtype=torch.float64, requires_grad=True)
    gravity = body.gravity.clone().requires_grad_()
    physics = body.physics(youngs_modulus=youngs, poissons_ratio=poisson, gravity=gravity)
    x0 = data["q0"].reshape(-1, 3).clone().requires_grad_()
    v0 = data["v0"].reshape(-1, 3).clone().requires_grad_()
    state = soft.State(x0, v0)
    stored = {int(k): row for row, k in enumerate(data["steps"])}
    compared = 0
    for k in range(1, num_steps + 1):
        state = held_step(body, data, state, data["active"][k], physics)
        if k in stored:
            close(state.x.flatten(), data["q"][stored[k]])
            close(state.v.flatten(), data["v"][stored[k]])
            compared += 1
    assert compared >= 2
    loss = (state.x.flatten() * data["wq"]).sum() + (state.v.flatten() * data["wv"]).sum()
    close(loss.reshape(1), data["loss20" if num_steps == 20 else "loss"])
    loss.backward()
    prefix = "dL20_" if num_steps == 20 else "dL_"
    close(x0.grad.flatten(), data[prefix + "dq0"], 1e-8)
    close(v0.grad.flatten(), data[prefix + "dv0"], 1e-8)
    close(torch.stack([youngs.grad, poisson.grad]), data[prefix + "dE_dnu"], 1e-8)
    if num_steps == 60:
        close(gravity.grad, data["dL_dgravity"], 1e-8)


def test_sets_found_by_ourselves(data, body):
    """The reference freezes a node where it is first found inside; we let it reach the plane.

    Until the first touch both agree. From then on the reference's node is held inside the plane
    by up to one step's motion, ours on it, so that ours leaves one step later (step 15); of thirty
    steps no other has another set.
    """
    normal, shift = plane_of(data)
    floor = contact.plane(normal, -shift, friction=math.inf)
    state = soft.State(data["q0"].reshape(-1, 3), data["v0"].reshape(-1, 3))
    differ = []
    for k in range(1, 31):
        after = body(state, obstacles=floor)
        assert violations(body, state, after, floor).worst < 1e-7
        if k < 5:
            close(after.x.flatten(), data["q_first"][k - 1])
        if not torch.equal(after.contact_force.abs().amax(1) > 0, data["active"][k]):
            differ.append(k)
        state = after
    assert differ == [15]
