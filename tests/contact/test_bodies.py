"""Two deformable bodies against each other: laws, gradients, a collision."""

import math

import pytest
import torch

from diffsim import contact, mesh, soft
from tests.contact.cases import tensor, uniform


def rough(m, amount: float, seed: int):
    """Positions of a mesh, displaced so that nothing is symmetric."""
    return m.x_rest + amount * uniform(m.num_nodes, 3, seed=seed)


def overlapping(kind: str = "tet"):
    """Two small boxes; b's upper part is in a's lower part, turned and rough."""
    make = mesh.tet_box if kind == "tet" else mesh.hex_box
    m_a, m_b = make((2, 2, 2), (1.0, 1.0, 1.0)), make((3, 2, 1), (0.7, 0.8, 0.5))
    turn = contact.box((1, 1, 1), rotation=(0.2, -0.3, 0.4)).rotation
    x_a, x_b = rough(m_a, 0.03, 1), rough(m_b, 0.02, 2) @ turn.T + tensor(0.15, 0.2, -0.4)
    return m_a, m_b, x_a, x_b


def states(kind: str = "tet"):
    m_a, m_b, x_a, x_b = overlapping(kind)
    v_a, v_b = uniform(*x_a.shape, seed=3), uniform(*x_b.shape, seed=4)
    return m_a, m_b, (x_a, v_a, x_b, v_b)


LAW = {"stiffness": 300.0, "damping": 0.2, "friction": 0.7, "slip_speed": 0.3}


@pytest.mark.property
@pytest.mark.parametrize("kind", ["tet", "hex"])
def test_forces_are_reciprocal_in_resultant_and_couple(kind):
    m_a, m_b, (x_a, v_a, x_b, v_b) = states(kind)
    on_a, on_b = contact.BodyContact(m_a, m_b, **LAW)(x_a, v_a, x_b, v_b)
    assert on_a.abs().max() > 0.1
    touched = int((on_a.norm(dim=1) > 0).sum())
    assert touched > 5  # several nodes and triangles
    torch.testing.assert_close(on_a.sum(0), -on_b.sum(0), rtol=0, atol=1e-12)
    couple_a = torch.linalg.cross(x_a, on_a).sum(0)
    couple_b = torch.linalg.cross(x_b, on_b).sum(0)
    torch.testing.assert_close(couple_a, -couple_b, rtol=0, atol=1e-12)
    # friction is what needs the compensation: it is not small here
    smooth = contact.BodyContact(m_a, m_b, **{**LAW, "friction": 0.0})(x_a, v_a, x_b, v_b)[0]
    assert (on_a - smooth).abs().max() > 0.1


@pytest.mark.property
def test_exchanging_the_bodies_exchanges_the_forces():
    m_a, m_b, (x_a, v_a, x_b, v_b) = states()
    on_a, on_b = contact.BodyContact(m_a, m_b, **LAW)(x_a, v_a, x_b, v_b)
    again_b, again_a = contact.BodyContact(m_b, m_a, **LAW)(x_b, v_b, x_a, v_a)
    torch.testing.assert_close(on_a, again_a, rtol=0, atol=1e-13)
    torch.testing.assert_close(on_b, again_b, rtol=0, atol=1e-13)


@pytest.mark.property
def test_forces_turn_with_the_scene():
    m_a, m_b, (x_a, v_a, x_b, v_b) = states()
    law = contact.BodyContact(m_a, m_b, **LAW)
    turn = contact.box((1, 1, 1), rotation=(1.0, -2.0, 0.7)).rotation
    shift, drift = tensor(3.0, -1.0, 2.0), tensor(5.0, 4.0, -3.0)
    on_a, on_b = law(x_a, v_a, x_b, v_b)
    turned = law(
        x_a @ turn.T + shift, v_a @ turn.T + drift, x_b @ turn.T + shift, v_b @ turn.T + drift
    )
    torch.testing.assert_close(turned[0], on_a @ turn.T, rtol=0, atol=1e-11)
    torch.testing.assert_close(turned[1], on_b @ turn.T, rtol=0, atol=1e-11)


@pytest.mark.reference
def test_a_flat_block_pressed_into_another_feels_pressure_times_area():
    """Block a above block b, the same depth everywhere: k depth area, once over both halves."""
    m_a = mesh.tet_box((2, 2, 1), (0.5, 0.5, 0.5), origin=(0.25, 0.25, 0.0))
    m_b = mesh.tet_box((4, 4, 2), (1.0, 1.0, 1.0), origin=(0.0, 0.0, -1.0))
    depth, k = 0.01, 1e4
    x_a = m_a.x_rest - tensor(0.0, 0.0, depth)
    rest_a, rest_b = torch.zeros_like(x_a), torch.zeros_like(m_b.x_rest)
    on_a, on_b = contact.BodyContact(m_a, m_b, stiffness=k)(x_a, rest_a, m_b.x_rest, rest_b)
    on_bottom = m_a.x_rest[:, 2] == 0
    # a's half: bottom nodes, whose area counts the adjoining sides too (0.25 m^2 + half of these)
    own = 0.5 * k * depth * float(_area(m_a)[on_bottom].sum())
    # b's half: the nodes of b in a's footprint; on its rim they lie on a's sides: depth zero
    inner = ((m_b.x_rest - tensor(0.5, 0.5, 0.0)).abs() < 0.2).all(1)
    other = 0.5 * k * depth * float(_area(m_b)[inner].sum())
    assert int(inner.sum()) == 1
    assert on_a.sum(0).tolist() == pytest.approx([0.0, 0.0, own + other], abs=1e-9)
    assert on_b[:, 2].sum().item() == pytest.approx(-own - other)


def _area(m):
    """Each node's third of the area of its surface triangles, by Heron's formula."""
    area = torch.zeros(m.num_nodes).double()
    for triangle in mesh.surface_triangles(m).faces.tolist():
        a, b, c = (m.x_rest[i] for i in triangle)
        p, q, r = (float((u - w).norm()) for u, w in ((a, b), (b, c), (c, a)))
        s = 0.5 * (p + q + r)
        area[triangle] += math.sqrt(s * (s - p) * (s - q) * (s - r)) / 3.0
    return area


def test_bodies_apart_feel_nothing_and_cost_no_search(monkeypatch):
    m_a, m_b, (x_a, v_a, x_b, v_b) = states()
    law = contact.BodyContact(m_a, m_b, **LAW)

    def search(*arguments):
        raise AssertionError("the boxes are apart")

    monkeypatch.setattr(mesh.SurfaceDistance, "of_triangles", search)
    on_a, on_b = law(x_a, v_a, x_b + tensor(5.0, 0.0, 0.0), v_b)
    assert on_a.abs().max() == 0 and on_b.abs().max() == 0
    assert on_a.shape == x_a.shape and on_b.shape == x_b.shape


@pytest.mark.grad
def test_a_node_exactly_on_the_surface_feels_nothing_and_gradients_are_finite():
    m = mesh.tet_box((1, 1, 1), (1.0, 1.0, 1.0))
    x_a = (m.x_rest + tensor(0.0, 0.0, 1.0)).requires_grad_()  # faces, edges and nodes coincide
    law = contact.BodyContact(m, m, **LAW)
    rest = torch.zeros_like(m.x_rest).requires_grad_()
    on_a, on_b = law(x_a, rest, m.x_rest, rest)
    assert on_a.abs().max() == 0 and on_b.abs().max() == 0
    nudged, _ = law(x_a - tensor(1e-3, 2e-3, 1e-9), rest, m.x_rest, rest)
    grads = torch.autograd.grad(nudged.square().sum(), (x_a, rest))
    assert all(torch.isfinite(g).all() for g in grads)


def test_batch_axes():
    m_a, m_b, (x_a, v_a, x_b, v_b) = states()
    law = contact.BodyContact(m_a, m_b, **LAW)
    far = x_b + tensor(0.0, 0.0, -9.0)
    batch = law(
        x_a.expand(2, 1, -1, -1),
        v_a.expand(2, 1, -1, -1),
        torch.stack([x_b, far])[:, None],
        v_b.expand(2, 1, -1, -1),
    )
    alone = law(x_a, v_a, x_b, v_b)
    for together, single in zip(batch, alone, strict=True):
        assert torch.equal(together[0, 0], single) and together[1].abs().max() == 0


def _collide(damping: float, friction: float, speed: float = 1.0, num_steps: int = 110):
    """Two balls of 20 mm meet off center; momenta [kg m/s], [kg m^2/s] and energy per step [J]."""
    ball = mesh.tet_sphere(0.02, 0.012)  # 77 nodes
    body = soft.SoftBody(
        ball,
        dt=2e-4,
        youngs_modulus=1e5,
        poissons_ratio=0.3,
        density=1000.0,
        gravity=(0.0, 0.0, 0.0),
        integrator="semi_implicit_euler",
    )
    law = contact.BodyContact(
        ball, ball, stiffness=5e7, damping=damping, friction=friction, slip_speed=1e-3
    )
    mass = body.physics().mass[:, None]
    a = soft.State(ball.x_rest.clone(), torch.zeros_like(ball.x_rest))
    away = tensor(0.0402, 0.008, 0.003)
    b = soft.State(ball.x_rest + away, torch.zeros_like(ball.x_rest) + tensor(-speed, 0.0, 0.0))
    record = []
    for _ in range(num_steps + 1):
        linear = (mass * (a.v + b.v)).sum(0)
        turning = (mass * (torch.linalg.cross(a.x, a.v) + torch.linalg.cross(b.x, b.v))).sum(0)
        kinetic = 0.5 * (mass * (a.v.square() + b.v.square())).sum()
        energy = kinetic + body.elastic_energy(a.x) + body.elastic_energy(b.x)
        record.append((linear, turning, energy, (mass * a.v).sum(0) / mass.sum()))
        on_a, on_b = law(a.x, a.v, b.x, b.v)
        a, b = body(a, external_force=on_a), body(b, external_force=on_b)
    return [torch.stack(column) for column in zip(*record, strict=True)]


@pytest.mark.property
def test_colliding_balls_keep_momentum_and_do_not_gain_energy():
    linear, turning, energy, struck = _collide(damping=0.5, friction=0.4)
    size = float(linear[0].norm()), 0.02 * float(linear[0].norm())
    assert (linear - linear[0]).norm(dim=1).max() < 1e-12 * size[0]
    assert (turning - turning[0]).norm(dim=1).max() < 1e-12 * size[1]
    assert struck[-1, 0] < -0.3  # [m/s]: it was struck
    assert struck[-1].norm() < 1.0
    # the penalty's own energy is not counted: compare after the balls have parted
    assert energy[-1] < energy[0]
    assert energy[-1] > 0.4 * energy[0]


@pytest.mark.reference
def test_an_elastic_collision_turns_the_velocity_along_the_normal():
    """Without friction and damping the struck ball leaves along the line of centers."""
    _, _, _, struck = _collide(damping=0.0, friction=0.0, speed=0.5)
    along = -struck[-1] / struck[-1].norm()
    centers = tensor(0.0402, 0.008, 0.003)
    contact_normal = centers / centers.norm()
    angle = math.degrees(math.acos(float(along @ contact_normal)))
    assert angle < 10.0  # facets of a coarse ball
