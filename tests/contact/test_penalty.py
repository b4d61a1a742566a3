"""Penalty forces against the published code's vectors and by their own laws."""

import math

import numpy as np
import pytest
import torch

from diffsim import contact
from tests.contact.cases import points, tensor, uniform
from tests.measured import data_folder


def vectors() -> dict[str, torch.Tensor]:
    with np.load(data_folder("soft_reference") / "penalty_contact.npz") as data:
        return {name: torch.as_tensor(data[name]) for name in data.files}


def nodes(flat: torch.Tensor) -> torch.Tensor:
    return flat.reshape(-1, 3).clone().requires_grad_()


def check(force, inputs, expected, jacobians, skip=()):
    """Force and Jacobians with rows 3 * node + axis; ``skip`` names nodes left out."""
    rows = torch.ones(len(expected), dtype=torch.bool)
    rows[[3 * n + axis for n in skip for axis in range(3)]] = False
    torch.testing.assert_close(
        force(*inputs).detach().reshape(-1), expected, rtol=1e-13, atol=1e-13
    )
    found = torch.autograd.functional.jacobian(lambda *a: force(*a).reshape(-1), tuple(inputs))
    assert all(float(j.abs().max()) > 0 for j in jacobians[:2])
    for ours, theirs in zip(found, jacobians, strict=True):
        ours = ours.reshape(len(expected), -1)
        scale = float(theirs.abs().max())
        torch.testing.assert_close(ours[rows], theirs[rows], rtol=1e-9, atol=1e-12 * scale)


@pytest.mark.reference
@pytest.mark.parametrize("exponent", [2, 3])
def test_plane_agrees_with_the_published_code(exponent):
    d = vectors()
    normal = d["planar_normal"]
    # their distance n.q + o is ours n.q - offset, both divided by |n|
    plane = contact.plane(normal, -float(d["planar_offset"] / normal.norm()))

    def force(x, v, kn, kf, mu):
        return contact.penalty_force(
            [plane], x, v, stiffness=kn, exponent=exponent, friction=mu, viscous_cap=kf
        )

    name = f"planar_p{exponent}"
    kn, kf, mu = (k.clone() for k in d["planar_kn_kf_mu"])
    by_coefficient = d[f"{name}_df_dkn_kf_mu"].split(1, dim=1)
    jacobians = (d[f"{name}_df_dq"], d[f"{name}_df_dv"], *by_coefficient)
    check(force, (nodes(d["q"]), nodes(d["v"]), kn, kf, mu), d[f"{name}_f"], jacobians)


@pytest.mark.reference
def test_trough_agrees_with_the_published_code():
    """Except df/dq of node 16, which slides: there the published code lacks a transpose."""
    d = vectors()
    trough = contact.Obstacle(
        contact.Trough(
            float(d["arc_radius"]), float(d["arc_angle"]), axis=d["arc_axis"], start=d["arc_start"]
        ),
        position=d["arc_center"],
    )

    def force(x, v, kn, kf, mu):
        return contact.penalty_force(
            [trough], x, v, stiffness=kn, exponent=3, friction=mu, viscous_cap=kf
        )

    inputs = (nodes(d["q"]), nodes(d["v"]), *(k.clone() for k in d["arc_kn_kf_mu"]))
    by_coefficient = d["arc_df_dkn_kf_mu"].split(1, dim=1)
    touching = int((d["arc_f"].reshape(-1, 3).norm(dim=1) > 0).sum())
    assert touching > 1
    check(force, inputs, d["arc_f"], (d["arc_df_dq"], d["arc_df_dv"], *by_coefficient), skip=[16])
    assert torch.autograd.gradcheck(force, inputs)  # node 16 too


@pytest.mark.reference
def test_billiard_balls_agree_with_the_published_code():
    d = vectors()
    balls = torch.arange(24).reshape(-1, int(d["ball_nodes"]))

    def force(x, k, mu):
        v = d["ball_v"].reshape(-1, 3)
        return contact.ball_force(
            x, v, balls, radius=float(d["ball_radius"]), stiffness=k, friction=mu
        )

    inputs = (nodes(d["ball_q"]), d["ball_k"].clone(), d["ball_mu"].clone())
    jacobians = (d["ball_df_dq"], *d["ball_df_dk_dmu"].split(3, dim=1))
    check(force, inputs, d["ball_f"], jacobians)


@pytest.mark.grad
def test_at_first_touch_and_at_rest_gradients_are_finite():
    x = tensor((0.0, 0.0, 0.0), (0.0, 0.0, 0.1), (0.0, 0.0, -0.1)).requires_grad_()
    v = torch.zeros(3, 3).double().requires_grad_()
    force = contact.penalty_force(
        [contact.floor(friction=0.5)], x, v, stiffness=10.0, viscous_cap=2.0
    )
    assert force[:2].abs().max() == 0 and force[2].tolist() == [0.0, 0.0, 1.0]
    jacobian_v = torch.autograd.functional.jacobian(
        lambda v: contact.penalty_force(
            [contact.floor(friction=0.5)], x, v, stiffness=10.0, viscous_cap=2.0
        ),
        v,
    )
    grads = torch.autograd.grad(force.sum(), (x, v))
    assert all(torch.isfinite(g).all() for g in grads)
    assert grads[0][:, 2].tolist() == [0.0, 0.0, -10.0]  # not yet in contact: none
    expected = torch.diag(tensor(-2.0, -2.0, 0.0))
    torch.testing.assert_close(jacobian_v[2, :, 2], expected)  # viscous where nothing slides


@pytest.mark.property
def test_friction_opposes_slip_against_the_moving_surface():
    belt = contact.floor(velocity=(1.0, 0.0, 0.0), friction=0.5)
    x = tensor((0.0, 0.0, -0.01)).expand(3, 3).contiguous()
    v = tensor((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.001, 0.0, 0.0))
    force = contact.penalty_force([belt], x, v, stiffness=1e3, viscous_cap=100.0)
    assert force[0].tolist() == pytest.approx([0, 0, 10])  # carried along
    assert force[1].tolist() == pytest.approx([5, 0, 10])  # Coulomb: 0.5 * 10 N
    assert force[2].tolist() == pytest.approx([-0.1, 0, 10])  # viscous: 100 N s/m * 1 mm/s
    stuck = contact.penalty_force([belt], x, v, stiffness=1e3, viscous_cap=100.0, friction=math.inf)
    assert stuck[1].tolist() == pytest.approx([100, 0, 10])  # the cap alone


@pytest.mark.property
def test_damping_takes_energy_and_never_pulls():
    x = tensor((0.0, 0.0, -0.01)).expand(3, 3).contiguous()
    v = tensor((0.0, 0.0, -1.0), (0.0, 0.0, 1.0), (0.0, 0.0, 9.0))
    force = contact.penalty_force([contact.floor()], x, v, stiffness=1e3, damping=0.4)
    assert force[:, 2].tolist() == pytest.approx([14.0, 6.0, 0.0])


def test_chosen_nodes_and_batches():
    x, v = points(12).reshape(2, 6, 3), uniform(2, 6, 3, seed=1)
    law = {"stiffness": 10.0, "friction": 0.3, "viscous_cap": 1.0}
    full = contact.penalty_force([contact.floor()], x, v, **law)
    some = contact.penalty_force([contact.floor()], x, v, nodes=torch.tensor([4, 1]), **law)
    torch.testing.assert_close(some[:, [1, 4]], full[:, [1, 4]], rtol=0, atol=0)
    assert some[:, [0, 2, 3, 5]].abs().max() == 0 and full[:, [0, 2, 3, 5]].abs().max() > 0


@pytest.mark.property
def test_equal_balls_keep_momentum_and_friction_opposes_slip():
    x = tensor((0.0, 0.0, 0.0), (0.15, 0.0, 0.0), (5.0, 0.0, 0.0))
    v = tensor((0.0, 1.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    balls = torch.arange(3)[:, None]
    force = contact.ball_force(x, v, balls, radius=0.1, stiffness=100.0, friction=0.2)
    expected = tensor((-5.0, -1.0, 0.0), (5.0, 1.0, 0.0), (0.0, 0.0, 0.0))  # 100 N/m * 0.05 m
    torch.testing.assert_close(force, expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"nodes": torch.tensor([12])}, ValueError, r"indices of nodes in \[0, 12\), got 12"),
        ({"nodes": torch.tensor([1.0])}, TypeError, "nodes must be torch.int64"),
    ],
)
def test_bad_input_is_refused(options, error, message):
    with pytest.raises(error, match=message):
        contact.penalty_force(
            [contact.floor()], points(), points(), **{"stiffness": 1.0, **options}
        )
