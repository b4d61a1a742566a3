"""Small bodies have a factor and a search of their own."""

import pytest
import torch

from diffsim import mesh, soft
from tests.soft.cases import irregular_mesh, leaf, noise, rail_mask, soft_body, two_muscles


def bars(kind: str, method: str, **options) -> tuple[soft.SoftBody, soft.State, list]:
    """Nine bent bars with all that a tangent may hold, and the leaves of their gradients."""
    m = irregular_mesh(kind, cells=(4, 2, 2), size=(2.0, 1.0, 1.0), amount=0.03)
    body = soft_body(
        m,
        fixed=rail_mask(m),
        muscles=two_muscles(),
        rayleigh_beta=0.02,
        youngs_modulus=200.0,
        solver=soft.SolverOptions(method=method, **{"rtol": 1e-11, **options}),
    )
    shape = (9, m.num_nodes, 3)
    x = leaf(m.x_rest + 0.003 * noise(*shape, seed=1))
    v = leaf(0.03 * noise(*shape, seed=2))
    return body, soft.State(x, v), [x, v]


@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_answers_and_gradients_are_those_of_the_general_factor(kind):
    ends, grads = [], []
    for method in ("auto", "newton_cholesky"):
        body, state, leaves = bars(kind, method)
        stiffness = leaf(200.0)
        with soft.record_stats() as solves:
            end = body(state, physics=body.physics(youngs_modulus=stiffness)).x
            weight = noise(*end.shape, seed=3)
            grads.append(torch.autograd.grad((weight * end).sum(), [*leaves, stiffness]))
        ends.append(end)
        if method == "auto":  # one factor a step, on which a few gradients end the search
            assert bool((solves[0].num_factorizations <= 2).all())
            assert bool((solves[0].num_solves == 0).all())
            assert bool((solves[1].num_factorizations == 1).all())
    torch.testing.assert_close(ends[0], ends[1], rtol=0, atol=1e-10)
    for a, b in zip(*grads, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("stretch", [(0.4, 1.2, 1.2), (1.6, 1.3, 0.9), (-0.5, 1.0, 1.0)])
def test_steps_from_far_from_rest_end_where_newtons_do(stretch):
    """Near rest a line search takes stresses without singular values, elsewhere by them."""
    m = irregular_mesh("hex", cells=(3, 2, 2), size=(1.5, 1.0, 1.0), amount=0.03)
    one = noise(m.num_nodes, 1, seed=4).abs()  # some elements are far from rest, others near
    x = m.x_rest * (1.0 + one.clamp(max=1.0) * (torch.tensor(stretch, dtype=torch.float64) - 1.0))
    ends = []
    for method in ("auto", "newton_cholesky"):
        solver = soft.SolverOptions(method=method, rtol=1e-11)
        body = soft_body(m, fixed=rail_mask(m), youngs_modulus=200.0, solver=solver)
        ends.append(body(soft.State(x, torch.zeros_like(x))).x)
    torch.testing.assert_close(*ends, rtol=0, atol=1e-9)


def test_an_adjoint_goes_on_by_the_factor_of_its_step():
    """The first who asks finds it and takes it, the second makes it again: the same bits."""
    body, state, leaves = bars("hex", "linearly_implicit")
    with soft.record_stats() as solves:
        end = body(body(state)).x
        loss = (noise(*end.shape, seed=3) * end).sum()
        grads = [torch.autograd.grad(loss, leaves, retain_graph=True) for _ in range(2)]
    made = [s.num_factorizations.unique().tolist() for s in solves]
    assert made == [[1.0], [1.0], [0.0], [0.0], [1.0], [1.0]]
    assert all(torch.equal(a, b) for a, b in zip(*grads, strict=True))


def test_a_member_that_buckles_leaves_the_others_as_they_are():
    body, state, _ = bars("hex", "auto")
    x = state.x.detach().clone()
    x[1, :, 0] *= 0.5  # its tangent is not definite: it goes to the solver of larger bodies
    state = soft.State(x, state.v.detach())
    with soft.record_stats() as solves:
        many = body(state).x
    assert bool((solves[0].converged == 1).all())
    assert solves[0].num_solves.gt(0).tolist() == [k == 1 for k in range(9)]
    for k in (0, 1, 8):
        assert torch.equal(body(soft.State(x[k], state.v[k])).x, many[k])


def test_a_body_with_a_chamber_goes_on_by_its_own_first_factor():
    """The small factor leaves chambers out: one tangent is factored and serves the steps after it.

    To twelve digits that is the cheapest with every instruction set; to ten, SSE2 iterates.
    """
    box = mesh.hex_box((3, 3, 3), (3.0, 3.0, 3.0))
    inside = ((box.x_rest[box.elements].mean(1) - 1.5).abs() < 0.5).all(1)
    shell = mesh.HexMesh(box.x_rest, box.elements[~inside])
    ends = []
    for method in ("auto", "newton_cholesky"):
        body = soft_body(
            shell,
            youngs_modulus=3000.0,
            dt=0.3,
            chambers=[soft.PressureChamber.from_cavity(shell)],
            solver=soft.SolverOptions(method=method, rtol=1e-12),
        )
        pressure = torch.tensor([3.0], dtype=torch.float64)
        with soft.record_stats() as solves:
            ends.append(body(body.rest_state(), pressure=pressure).x)
        if method == "auto":
            assert float(solves[0].num_factorizations[0]) == 1
            assert float(solves[0].num_iters[0]) > 1
    torch.testing.assert_close(*ends, rtol=0, atol=1e-9)


def test_a_tolerance_below_rounding_ends_and_is_reported():
    body, state, _ = bars("hex", "auto", rtol=1e-19, max_iters=60, on_failure="warn")
    with pytest.warns(Warning, match="stopped after"), soft.record_stats() as solves:
        body(state)
    assert float(solves[0].residual_norm.max()) < 1e-9 * float(solves[0].scale.max())
