"""What must hold whatever the numbers: symmetry, conservation, energy, patch tests, constraints."""

import math

import numpy as np
import pytest
import torch

from diffsim import mesh, soft
from tests.soft.cases import deformed, irregular_mesh, leaf, noise, soft_body, two_muscles

pytestmark = pytest.mark.property
IMPLICIT = ["implicit_euler", "bdf2", "implicit_midpoint"]
INTEGRATORS = [*IMPLICIT, "semi_implicit_euler"]
KINDS = ["hex", "tet"]
# Solves end at 1e-12 of the force scale; a step's position error is that over the inertia.
TIGHT = 1e-9


def close(actual, expected, tol=TIGHT):
    torch.testing.assert_close(actual, expected, rtol=tol, atol=tol)


def rotation(seed: int = 3) -> torch.Tensor:
    q = torch.linalg.qr(noise(3, 3, seed=seed))[0]
    return q * torch.linalg.det(q)


def momentum(mass, state):
    return (mass[:, None] * state.v).sum(0)


def angular_momentum(mass, state):
    return (mass[:, None] * torch.linalg.cross(state.x, state.v)).sum(0)


def kinetic(mass, state):
    return 0.5 * (mass[:, None] * state.v**2).sum()


def run(body, state, num_steps, **inputs):
    for _ in range(num_steps):
        state = body(state, **inputs)
    return state


def free_body(kind, integrator="implicit_euler", **changes):
    m = irregular_mesh(kind, (2, 1, 1) if kind == "hex" else (1, 1, 1), (1.0, 1.0, 1.0))
    return soft_body(m, **{"gravity": (0.0, 0.0, 0.0), "integrator": integrator, **changes})


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_rest_stays_at_rest(integrator, kind):
    body = free_body(kind, integrator, rayleigh_beta=0.01, rayleigh_alpha=0.3, dt=0.02)
    rest = body.rest_state()
    # The iteration starts at the answer; only rounding of F = I moves nodes.
    after = run(body, rest, 5)
    close(after.x, rest.x, 1e-13)
    close(after.v, rest.v, 1e-11)
    close(body.elastic_energy(rest.x), torch.zeros((), dtype=torch.float64), 1e-25)
    close(body.elastic_force(rest.x), torch.zeros_like(rest.x), 1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_free_bodies_keep_their_momentum(integrator, kind):
    """All integrators keep linear momentum, damped or not. The explicit one also keeps angular
    momentum
    (its force is a torque-free function of x_n; x_{n+1} x v_{n+1} = x_n x v_{n+1})."""
    body = free_body(kind, integrator, dt=0.02, rayleigh_beta=0.01)
    mass = body.physics().mass
    start = soft.State(deformed(body.mesh), noise(body.mesh.num_nodes, 3))
    end = run(body, start, 10)
    # The residual, 1e-12 of about 1e3 N, acts over 0.2 s.
    close(momentum(mass, end), momentum(mass, start), 1e-8)
    undamped = free_body(kind, integrator, dt=0.02)
    end = run(undamped, start, 10)
    drift = (angular_momentum(mass, end) - angular_momentum(mass, start)).norm()
    scale = angular_momentum(mass, start).norm()
    if integrator in ("semi_implicit_euler", "implicit_midpoint"):
        assert drift < 1e-8 * scale
    elif integrator == "implicit_euler":
        # x_{n+1} x v_{n+1} - x_n x v_n = -h v_n x (v_{n+1} - v_n): first order in h, and a loss.
        assert 1e-3 * scale < drift < 0.5 * scale
    else:
        assert drift < 0.2 * scale


def spin(body, speed):
    """Rigid rotation about the center of mass, at rest length."""
    mass = body.physics().mass[:, None]
    center = (mass * body.x_rest).sum(0) / mass.sum()
    omega = speed * torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64)
    v = torch.linalg.cross(omega.expand_as(body.x_rest), body.x_rest - center)
    return soft.State(body.x_rest.clone(), v)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_damping_does_not_brake_rigid_rotation(integrator, kind):
    """A stiff body that spins loses the same angular momentum with and without rayleigh_beta.

    Material damping knows strain rates only. Classical beta K v with the rest stiffness would stop
    this
    body within 1 / (beta w^2), a thousandth of the time simulated.
    """
    results = []
    for beta in (0.0, 0.05):
        body = free_body(kind, integrator, dt=0.005, youngs_modulus=300.0, rayleigh_beta=beta)
        start = spin(body, 1.0)
        end = run(body, start, 40)
        mass = body.physics().mass
        results.append(angular_momentum(mass, end).norm() / angular_momentum(mass, start).norm())
    plain, damped = map(float, results)
    # Turned by 0.2 rad. Implicit Euler alone loses h w^2 T = 1e-3; the rest is what the body
    # stretches,
    # which damping changes a little: 2e-4. Braking would be of order one.
    assert abs(damped - plain) < 5e-4
    expected = 1.0 - 0.005 * 1.0 * 0.2 if integrator == "implicit_euler" else 1.0
    assert abs(plain - expected) < 3e-4


def test_the_damping_force_of_a_rigid_rotation_is_zero():
    body = free_body("hex", "semi_implicit_euler", rayleigh_beta=0.05, dt=1e-3)
    plain = free_body("hex", "semi_implicit_euler", dt=1e-3)
    state = spin(body, 2.0)
    turn = rotation()
    turned = soft.State(state.x @ turn.T, state.v @ turn.T)
    for start in (state, turned):
        close(body(start).v, plain(start).v, 1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_implicit_euler_never_gains_energy(kind):
    body = free_body(kind, "implicit_euler", dt=0.05)
    state = soft.State(deformed(body.mesh), 0.5 * noise(body.mesh.num_nodes, 3))
    mass = body.physics().mass
    energies = []
    for _ in range(40):
        energies.append(float(kinetic(mass, state) + body.elastic_energy(state.x)))
        state = body(state)
    assert np.all(np.diff(energies) < 1e-10)
    assert energies[-1] < 0.6 * energies[0]


@pytest.mark.parametrize("kind", KINDS)
def test_implicit_midpoint_nearly_keeps_energy(kind):
    """Amplitudes of 5 %: the remaining wobble is O((w h)^2) of the energy and does not drift."""
    wobble = []
    for dt in (0.02, 0.01):
        body = free_body(kind, "implicit_midpoint", dt=dt)
        state = soft.State(
            body.x_rest + 0.02 * noise(body.mesh.num_nodes, 3), torch.zeros_like(body.x_rest)
        )
        mass = body.physics().mass
        energies = []
        for _ in range(round(2.0 / dt)):
            energies.append(float(kinetic(mass, state) + body.elastic_energy(state.x)))
            state = body(state)
        wobble.append(np.ptp(energies) / energies[0])
    assert wobble[0] < 0.05
    assert wobble[1] < 0.4 * wobble[0]  # second order: a quarter


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_free_fall_is_a_parabola(integrator, kind):
    gravity = torch.tensor([0.1, 0.2, -9.81], dtype=torch.float64)
    dt, steps = 0.02, 10
    body = free_body(kind, integrator, dt=dt, gravity=gravity, attached_mass=None)
    v0 = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    start = soft.State(body.x_rest, v0.expand_as(body.x_rest).contiguous())
    end = run(body, start, steps)
    time = dt * steps
    close(end.v, (v0 + time * gravity).expand_as(end.v), 1e-8)
    # Exact sums: midpoint is exact; both Euler methods fall h t g / 2 further; BDF2's first step is
    # implicit Euler and its error decays by thirds to a constant h^2 / 2 + ... (checked to order
    # h^2).
    fall = (end.x - body.x_rest - time * v0).mean(0) / gravity
    close(end.x - body.x_rest, (end.x - body.x_rest).mean(0).expand_as(end.x), 1e-8)
    exact = 0.5 * time**2
    if integrator == "implicit_midpoint":
        close(fall, torch.full_like(fall, exact), 1e-8)
    elif integrator == "bdf2":
        assert (fall - exact).abs().max() < dt**2
    else:
        close(fall, torch.full_like(fall, exact + 0.5 * dt * time), 1e-8)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_numbering_does_not_matter(integrator, kind):
    m = irregular_mesh(kind, (2, 1, 1))
    order = torch.randperm(m.num_nodes, generator=torch.Generator().manual_seed(0))
    place = torch.argsort(order)  # old node -> new node
    shuffle = torch.randperm(m.num_elements, generator=torch.Generator().manual_seed(1))
    other = type(m)(m.x_rest[order], place[m.elements[shuffle]])
    elements = torch.argsort(shuffle)[torch.tensor([0, 1])]
    results = []
    for this, pick, muscle_elements in (
        (m, slice(None), torch.tensor([0, 1])),
        (other, order, elements),
    ):
        muscle = soft.Muscle(elements=muscle_elements, direction=[1.0, 0.2, 0.0], stiffness=8.0)
        fixed = torch.zeros(m.num_nodes, 3, dtype=torch.bool)
        fixed[:2] = True
        fixed[2, 1] = True
        body = soft_body(
            this,
            fixed=fixed[pick],
            muscles=[muscle],
            integrator=integrator,
            rayleigh_beta=0.02,
            dt=0.02,
        )
        x, v = leaf(deformed(m)[pick]), leaf(noise(m.num_nodes, 3)[pick])
        state = run(body, soft.State(x, v), 2, activation=torch.tensor([0.8], dtype=torch.float64))
        grads = torch.autograd.grad((state.x * noise(m.num_nodes, 3, seed=4)[pick]).sum(), (x, v))
        results.append((state.x, state.v, *grads))
    for one, renumbered in zip(*results, strict=True):
        close(renumbered, one[order], 1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_the_tangent_is_symmetric(kind):
    """<J v, w> = <v, J w> of the elastic force, at a strongly deformed state with inverted
    elements."""
    body = soft_body(irregular_mesh(kind), muscles=two_muscles())
    for amount in (0.25, 2.0):
        x = leaf(deformed(body.mesh, amount))
        force = body.elastic_force(x, activation=torch.tensor([0.7, 0.2], dtype=torch.float64))
        a, b = noise(*x.shape, seed=1), noise(*x.shape, seed=2)
        (ja,) = torch.autograd.grad(force, x, a, retain_graph=True)
        (jb,) = torch.autograd.grad(force, x, b)
        scale = ja.norm() * b.norm()
        assert abs((ja * b).sum() - (jb * a).sum()) < 1e-13 * scale


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("volume_weight", ["small_strain", "thesis"])
def test_patch(kind, volume_weight):
    """Boundary nodes follow x -> A x + b: all nodes do, whatever the shape of the elements
    inside."""
    box = (mesh.hex_box if kind == "hex" else mesh.tet_box)((3, 3, 3))
    inside = ((box.x_rest > 1e-9) & (box.x_rest < 1 - 1e-9)).all(1)
    moved = box.x_rest + 0.06 * inside[:, None] * noise(box.num_nodes, 3).clamp(-1.5, 1.5)
    m = type(box)(moved, box.elements)
    body = soft_body(m, fixed=~inside, gravity=(0.0, 0.0, 0.0), volume_weight=volume_weight)
    strain = torch.eye(3, dtype=torch.float64) + torch.tensor(
        [[0.15, 0.1, -0.05], [0.0, -0.1, 0.2], [0.05, 0.0, 0.1]], dtype=torch.float64
    )
    target = m.x_rest @ strain.T + torch.tensor([0.5, -1.0, 2.0])
    state = body.static_equilibrium(dirichlet_target=target)
    close(state.x, target, 1e-10)
    # Energy of a homogeneous field does not depend on the mesh.
    reference = soft_body(mesh.hex_box((1, 1, 1)), volume_weight=volume_weight)
    expected = reference.elastic_energy(reference.x_rest @ strain.T)
    close(body.elastic_energy(target), expected, 1e-12)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_rail_leaves_one_axis_free(integrator):
    m = irregular_mesh("hex", (2, 1, 1))
    mask = torch.zeros(m.num_nodes, 3, dtype=torch.bool)
    mask[:, 1:] = True
    body = soft_body(m, fixed=mask, gravity=(2.0, -1.0, -3.0), integrator=integrator, dt=0.02)
    end = run(body, body.rest_state(), 10)
    close(end.x[:, 1:], m.x_rest[:, 1:], 1e-13)
    shift = end.x[:, 0] - m.x_rest[:, 0]
    # All nodes slide along x together: nothing is strained.
    close(shift, shift.mean().expand_as(shift), 1e-8)
    assert shift.mean() == pytest.approx(0.5 * 2.0 * 0.2**2, rel=0.11)  # Euler: + h / t


def bar(cells=(8, 2, 2), **changes):
    m = mesh.hex_box(cells, (1.0, 0.2, 0.2))
    options = {
        "youngs_modulus": 1e6,
        "poissons_ratio": 0.0,
        "density": 1000.0,
        "gravity": (0.0, 0.0, -9.81),
        "fixed": m.nodes_near_plane("x", 0.0),
    }
    return soft_body(m, **{**options, **changes})


def test_attached_mass_pulls_and_slows():
    """Axial bar: the extra mass stretches it by m g l / (E A), and lowers its frequency."""
    body = bar(gravity=(9.81, 0.0, 0.0))
    tip = body.mesh.nodes_near_plane("x", 1.0)
    extra = torch.zeros(body.mesh.num_nodes, dtype=torch.float64)
    share = body.nodal_volume[tip] / body.nodal_volume[tip].sum()  # as if spread over the end face
    extra[tip] = 4.0 * share  # 4 kg on a bar of 40 kg
    loaded = body.physics(attached_mass=extra)
    plain, heavy = (body.static_equilibrium(physics=p).x[tip, 0] @ share for p in (None, loaded))
    # At nu = 0 the corotated stress is linear in the stretch: exact but for the solver's 1e-12 N.
    assert float(heavy - plain) == pytest.approx(4.0 * 9.81 / (1e6 * 0.04), rel=1e-8)

    # Rod with mass M at its end: modes sin(q x / l), q tan q = m / M; w = q c / l, c = sqrt(E /
    # rho).
    # m / M is infinite and one. Eight lumped elements and steps of 2 ms lower w by 0.2 and 0.1 %.
    body = bar(integrator="implicit_midpoint", dt=2e-3)
    for q, mass in ((math.pi / 2, 0.0 * extra), (0.86033, 10.0 * extra)):
        physics = body.physics(gravity=(0.0, 0.0, 0.0), attached_mass=mass)
        x = body.x_rest.clone()
        x[:, 0] += 1e-4 * torch.sin(q * x[:, 0])
        state, before, k = soft.State(x, torch.zeros_like(x)), 1.0, 0
        while (now := float((state.x - body.x_rest)[tip, 0] @ share)) > 0.0:
            state, before, k = body(state, physics=physics), now, k + 1
        quarter = 2e-3 * (k - 1 + before / (before - now))
        assert quarter == pytest.approx(math.pi / 2 / (q * math.sqrt(1e6 / 1000.0)), rel=6e-3)


@pytest.mark.parametrize("muscle_kind", ["length", "contraction"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_muscle_shortens_its_body(muscle_kind, kind):
    m = (mesh.hex_box if kind == "hex" else mesh.tet_box)((4, 2, 2), (1.0, 0.2, 0.2))
    muscle = soft.Muscle(
        elements=torch.arange(m.num_elements),
        direction=[1.0, 0.0, 0.0],
        stiffness=20.0,
        kind=muscle_kind,
    )
    body = soft_body(
        m,
        fixed=m.nodes_near_plane("x", 0.0),
        gravity=(0.0, 0.0, 0.0),
        muscles=[muscle],
        poissons_ratio=0.0,
    )
    tip = m.nodes_near_plane("x", 1.0)
    lengths = []
    for activation in (1.0, 0.9, 0.7, 0.5):
        pull = torch.tensor([activation], dtype=torch.float64)
        lengths.append(float(body.static_equilibrium(activation=pull).x[tip, 0].mean()))
        if muscle_kind == "length":
            # nu = 0: E (s - 1) + w (s - a) = 0.
            assert lengths[-1] == pytest.approx((30.0 + 20.0 * activation) / 50.0, rel=1e-6)
        else:
            w = 20.0 * (1.0 - activation) ** 2
            assert lengths[-1] == pytest.approx(30.0 / (30.0 + w), rel=1e-6)
    assert lengths[0] == pytest.approx(1.0, abs=1e-12)
    assert all(np.diff(lengths) < 0.0)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("starts_at_rest", [False, True])
def test_a_moving_boundary_is_followed(integrator, starts_at_rest):
    """A body that is carried as a whole arrives where it is carried, at the carrier's velocity."""
    m = irregular_mesh("hex", (2, 1, 1))
    body = soft_body(m, fixed=torch.arange(m.num_nodes), integrator=integrator, dt=0.02)
    speed = torch.tensor([1.0, -0.5, 2.0], dtype=torch.float64)
    state = soft.State(m.x_rest, (0.0 if starts_at_rest else 1.0) * speed.expand_as(m.x_rest))
    for k in range(5):
        state = body(state, dirichlet_target=m.x_rest + speed * 0.02 * (k + 1))
    close(state.x, m.x_rest + 0.1 * speed, 1e-13)
    # BDF2 takes two steps to forget that the nodes were at rest before
    if not (starts_at_rest and integrator == "bdf2"):
        close(state.v, speed.expand_as(state.v), 1e-11)
