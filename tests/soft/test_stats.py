"""record_stats: what it lists, and that it stops listening."""

import torch

from diffsim import mesh, soft


def make_body():
    box = mesh.hex_box((2, 1, 1), (0.2, 0.1, 0.1))
    return soft.SoftBody(
        box,
        dt=1e-2,
        youngs_modulus=1e5,
        poissons_ratio=0.3,
        fixed=box.x_rest[:, 0] == 0,
        solver=soft.SolverOptions(method="newton_cholesky", rtol=1e-8),
    )


def test_steps_and_adjoints_are_listed_in_order():
    body = make_body()
    x = body.x_rest.clone().requires_grad_()
    with soft.record_stats() as solves:
        end = soft.rollout(body, soft.State(x, torch.zeros_like(x)), 2).final
        end.x.square().sum().backward()
    assert [s.kind for s in solves] == ["step", "step", "adjoint", "adjoint"]
    for s in solves:
        assert s.converged.item() == 1
        assert s.residual_norm.item() <= s.tolerance.item()
        assert s.num_factorizations.item() >= 1


def test_a_batch_has_one_row_per_item():
    body = make_body()
    with soft.record_stats() as solves:
        body(body.rest_state(batch=3))
    assert solves[0].num_iters.shape == (3,)


def test_nothing_is_recorded_after_the_block():
    body = make_body()
    with soft.record_stats() as solves:
        pass
    body(body.rest_state())
    assert solves == []
