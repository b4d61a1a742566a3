"""Signorini's and Coulomb's laws after a step, checked without the code that found the answer.

Tolerance: steps stop at 1e-9 of the force scale, which is a few times the largest contact force.
"""

import itertools
import math

import pytest
import torch

import diffsim
from diffsim import contact, mesh, soft
from tests.contact.cases import tensor, uniform, waves
from tests.contact.scenes import moving, residual, slab, violations
from tests.covering import covering

pytestmark = pytest.mark.property
TOLERANCE = 1e-6


def walk(body, state, obstacles, num_steps, **inputs):
    """Steps with moving obstacles; every one is held against the law. Returns the violations."""
    seen = []
    for _ in range(num_steps):
        after = body(state, obstacles=obstacles, **inputs)
        found = violations(body, state, after, obstacles, **inputs)
        assert found.worst < TOLERANCE, found
        seen.append(found)
        state = after
        obstacles = [o.after(body.dt) for o in obstacles]
    return state, seen


def ball_at(z: float, mu: float) -> contact.Obstacle:
    return contact.sphere(1.0, position=(0.05, -0.1, z - 1.0), friction=mu)


def cube_mesh():
    return mesh.to_trimesh(mesh.tet_box((2, 2, 2), (2.0, 2.0, 1.0), origin=(-1, -1, -1)))


OBSTACLES = {
    "floor": lambda mu: [contact.floor(friction=mu)],
    "tilted plane": lambda mu: [contact.plane((0.3, -0.2, 1.0), -0.25, friction=mu)],
    "turned plane": lambda mu: [
        contact.plane((0, 0, 1), rotation=(0.2, 0.1, 0.3), position=(0, 0, -0.2), friction=mu)
    ],
    "sphere": lambda mu: [ball_at(0.0, mu)],
    "capsule": lambda mu: [
        contact.capsule((-2, 0, 0), (2, 0.3, 0), 0.5, position=(0, 0.1, -0.5), friction=mu)
    ],
    "box": lambda mu: [contact.box((2.5, 2.5, 0.5), position=(0, 0, -0.25), friction=mu)],
    "height field": lambda mu: [
        contact.Obstacle(
            contact.HeightField(waves(), 0.1, origin=(-1, -0.8, 0)), position=(0, 0, -0.1),
            friction=mu,
        )
    ],
    "mesh": lambda mu: [contact.Obstacle(contact.MeshShape(cube_mesh()), friction=mu)],
    "floor and wall": lambda mu: [
        contact.floor(friction=mu), contact.plane((-1, 0, 0), -0.55, friction=2 * mu)
    ],
    "container": lambda mu: [
        contact.Obstacle(
            contact.Sphere(1.0, inside_out=True), position=(0, 0, 0.6), friction=mu
        )
    ],
}  # fmt: skip


# A mesh and a height field are slow to detect, and the others say the rest.
FRICTIONS = {"mesh": (0.0, 0.3), "height field": (0.3,)}


@pytest.mark.parametrize(
    "name, mu", [(n, mu) for n in OBSTACLES for mu in FRICTIONS.get(n, (0.0, 0.3, math.inf))]
)
def test_landing_and_sliding_on_every_kind_of_obstacle(name, mu):
    body = slab("hex", height=0.02)
    body.solver = soft.SolverOptions(rtol=1e-9)
    state = moving(body, (0.8, 0.3, -1.5), spin=(0.2, -0.4, 0.5), wobble=0.1)
    _, seen = walk(body, state, OBSTACLES[name](mu), 6)
    assert max(s.num_contacts for s in seen) >= 2


@covering(mu=[0.01, 0.2, 0.7, 2.0], kind=["hex", "tet"], integrator=["implicit_euler", "bdf2"])
def test_stick_slip_and_lift_off(kind, mu, integrator):
    """A spinning slab dropped flat on its face: nodes stick, slip and leave within a few steps."""
    body = slab(kind, (3, 3, 1), integrator=integrator, solver=soft.SolverOptions(rtol=1e-9))
    state = moving(body, (0.5, 0.2, -1.0), spin=(0.0, 0.0, 2.0), wobble=0.3)
    _, seen = walk(body, state, [contact.floor(friction=mu)], 8)
    slipping = sum(s.num_slipping for s in seen)
    touching = sum(s.num_contacts for s in seen)
    assert touching > 15
    assert slipping > 0 or mu == 2.0
    if mu == 0.2:
        assert 0 < slipping < touching  # both kinds in one scene


MOTIONS = {
    "translating": {"velocity": (0.4, -0.2, 0.3)},
    "turning about z": {"angular_velocity": (0.0, 0.0, 2.0)},
    "tilting": {"angular_velocity": (0.5, 0.3, 0.0), "velocity": (0.1, 0.0, 0.2)},
}


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])
@pytest.mark.parametrize("motion", list(MOTIONS))
def test_moving_obstacles(motion, integrator):
    body = slab("tet", integrator=integrator, solver=soft.SolverOptions(rtol=1e-9))
    obstacle = contact.box((4, 4, 1), position=(0, 0, -0.5), friction=0.4, **MOTIONS[motion])
    state = moving(body, (0.0, 0.0, -0.2), wobble=0.05)
    _, seen = walk(body, state, [obstacle], 8)
    assert sum(s.num_contacts for s in seen) > 10


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])
def test_a_conveyor_takes_the_body_along(integrator):
    """Sliding friction accelerates by mu g until the belt's speed 0.3 is reached after 0.6 s."""
    body = slab(integrator=integrator, youngs_modulus=1e4, rayleigh_alpha=0.0)
    belt = contact.floor(velocity=(0.3, 0.0, 0.0), friction=0.5)
    state = body.rest_state()
    speeds = []
    mass = body.physics().mass
    for _ in range(12):
        state = body(state, obstacles=belt)
        speeds.append(float((mass * state.v[:, 0]).sum() / mass.sum()))
        belt = belt.after(body.dt)
    assert speeds[1] == pytest.approx(2 * 0.5 * 1.0 * body.dt, rel=0.1)
    assert speeds[-1] == pytest.approx(0.3, rel=2e-3)
    assert (state.v[body.contact_nodes, 0].max() - 0.3).abs() < 2e-3


def test_external_force_activation_and_dirichlet_nodes_elsewhere():
    body = slab("hex", (3, 2, 1), (1.5, 1.0, 0.5))
    held = body.x_rest[:, 0] > 0.7
    muscle = soft.Muscle(elements=torch.tensor([0, 1]), direction=[1.0, 0.2, 0.1], stiffness=50.0)
    body = slab(
        "hex", (3, 2, 1), (1.5, 1.0, 0.5), fixed=held, muscles=[muscle],
        solver=soft.SolverOptions(rtol=1e-9),
    )  # fmt: skip
    floor = contact.floor(friction=0.3)
    state = moving(body, (0.3, 0.0, -0.5))
    state = state._replace(v=torch.where(body.fixed, 0.0, state.v))
    external = 0.1 * uniform(body.mesh.num_nodes, 3, seed=4)
    activation = torch.tensor([0.7], dtype=torch.float64)
    touched = 0
    for _ in range(4):
        after = body(state, obstacles=floor, external_force=external, activation=activation)
        found = violations(body, state, after, floor, external, activation=activation)
        assert found.worst < TOLERANCE, found
        touched += found.num_contacts
        assert torch.equal(after.x[body.fixed], body.x_rest[body.fixed])
        assert bool((after.contact_force[held] == 0).all())
        state = after
    assert touched > 5


def test_a_corner_between_two_planes_uses_the_deeper_one():
    """One half space per node: the law holds for the half spaces that were used."""
    body = slab("tet", solver=soft.SolverOptions(rtol=1e-9))
    corner = [contact.floor(friction=0.5), contact.plane((1, 0, 0), -0.52, friction=0.5)]
    state = moving(body, (-0.8, 0.1, -0.3))
    _, seen = walk(body, state, corner, 6)
    assert sum(s.num_contacts for s in seen) > 10


@pytest.mark.slow
def test_infinite_friction_may_leave_no_answer():
    """A slab of which one node is pulled: no set of nodes, held or let go, obeys the law.

    All 512 sets are tried as Dirichlet conditions. The kernel then holds the node that it has
    released twice (contact_status.cpp), and such nodes slide in a second solve
    (soft/_ops_contact.py).
    """
    body = slab("hex", height=0.02, solver=soft.SolverOptions(rtol=1e-9))
    floor = contact.floor(friction=math.inf)
    state = moving(body, (0.8, 0.3, -1.5), spin=(0.2, -0.4, 0.5), wobble=0.1)
    for _ in range(3):
        state = body(state, obstacles=floor)
    with pytest.warns(diffsim.ContactWarning, match="without an answer"):
        after = body(state, obstacles=floor)
    assert violations(body, state, after, floor).worst < TOLERANCE
    bottom = torch.nonzero(body.x_rest[:, 2] < 0.03).flatten()
    floor_at = state.x * tensor(1.0, 1.0, 0.0)
    for chosen in itertools.product([False, True], repeat=len(bottom)):
        held = bottom[torch.tensor(chosen)]
        glued = slab("hex", height=0.02, fixed=held, solver=soft.SolverOptions(rtol=1e-9))
        end = glued(soft.State(state.x, state.v), dirichlet_target=floor_at)
        pressed = residual(glued, state, end)[held, 2]
        assert bool((pressed < -1e-6).any()) or bool((end.x[bottom, 2] < -1e-6).any())
