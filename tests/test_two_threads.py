"""Two threads of Python that step the same bodies and flows at once find the bits of one alone.

Kernels release Python's lock, so both threads are inside them at once: prepared systems, columns of
inverses, memories handed from step to step and analyses made on first use are shared.
"""

import math
import threading
from collections.abc import Callable

import pytest
import torch

from diffsim import contact, mesh, soft, stokes

pytestmark = pytest.mark.property
Answer = list[torch.Tensor]


def landing(friction: float | None) -> Callable[[], Answer]:
    """Three steps of a new body that the caller shares, and their gradient."""
    box = mesh.hex_box((4, 4, 3), (0.1, 0.1, 0.08), origin=(0.0, 0.0, 0.001))
    solver = soft.SolverOptions(rtol=1e-6, num_threads=1)
    body = soft.SoftBody(box, dt=5e-3, youngs_modulus=1e5, poissons_ratio=0.3, solver=solver)
    floor = None if friction is None else contact.floor(friction=friction)

    def run() -> Answer:
        v = torch.tensor([0.3, 0.1, -0.5], dtype=torch.float64).expand_as(box.x_rest)
        v = v.clone().requires_grad_()
        end = soft.rollout(body, soft.State(box.x_rest, v), 3, obstacles=floor).final
        return [end.x.detach(), *torch.autograd.grad((end.x**2).sum(), v)]

    return run


def channel(
    wall: str = "no_slip",
    solver: stokes.SolverOptions | None = None,
    *,
    incompressible: bool = False,
) -> Callable[[], Answer]:
    """A flow through a channel and its gradient to the height."""
    grid = stokes.Grid((12, 12), size=1.0)
    ends = (stokes.Inlet("x-"), stokes.Open("x+"))
    flow = stokes.StokesFlow(grid, ends, wall=wall, solver=solver, incompressible=incompressible)
    inflow = torch.tensor([1.0, 0.0], dtype=torch.float64)

    def run() -> Answer:
        height = torch.tensor(0.6, dtype=torch.float64, requires_grad=True)
        away = (grid.nodes[..., 1] - 0.5).abs()
        velocity = flow(0.5 * height - away, inlet=inflow).velocity
        return [velocity.detach(), *torch.autograd.grad((velocity**2).sum(), height)]

    return run


def at_once(work: Callable[[], Answer], threads: int = 2, rounds: int = 3) -> list[Answer]:
    """What each thread finds, round after round, all starting together."""
    answers: list[Answer] = []
    gate = threading.Barrier(threads)

    def run() -> None:
        for _ in range(rounds):
            gate.wait(timeout=60.0)
            answers.append(work())

    workers = [threading.Thread(target=run) for _ in range(threads)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert len(answers) == threads * rounds  # none raised
    return answers


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda: landing(None), id="soft"),
        pytest.param(lambda: landing(0.4), id="contact"),
        pytest.param(lambda: landing(math.inf), id="sticking"),
        pytest.param(channel, id="stokes"),
        pytest.param(lambda: channel(incompressible=True), id="incompressible"),
    ],
)
def test_threads_share_a_prepared_solver(make):
    alone = make()()
    for found in at_once(make()):
        assert all(map(torch.equal, found, alone))
