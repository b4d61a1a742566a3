"""record_stats stops listening after its block."""

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


def test_nothing_is_recorded_after_the_block():
    body = make_body()
    with soft.record_stats() as solves:
        pass
    body(body.rest_state())
    assert solves == []
