"""The same bits whatever the number of threads, in a batch or alone, once or again."""

import pytest
import torch

from diffsim import contact, soft
from tests.contact.scenes import moving, slab
from tests.soft.cases import leaf

pytestmark = pytest.mark.property


def run(batch=(0, 1, 2), threads=1, method="auto", cells=(4, 3, 2)):
    """Two steps of several slabs that land, slip and spin differently; answers and gradients."""
    options = soft.SolverOptions(method=method, rtol=1e-8, num_threads=threads)
    body = slab("hex", cells, (1.0, 0.8, 0.5), solver=options)
    states = [
        moving(body, (0.3 * k, 0.2, -1.0), spin=(0.1, 0.2 * k, 1.0), wobble=0.2, seed=k)
        for k in batch
    ]
    x = leaf(torch.stack([s.x for s in states]))
    v = leaf(torch.stack([s.v for s in states]))
    mu = leaf(0.3)
    state = soft.State(x, v)
    obstacles = [contact.floor(friction=mu), contact.plane((-1, 0, 0), -0.55, friction=0.1)]
    for _ in range(2):
        state = body(state, obstacles=obstacles)
    loss = (state.x * state.v).sum((1, 2)) + state.contact_force.square().sum((1, 2))
    grads = torch.autograd.grad(loss.sum(), (x, v))
    return [state.x.detach(), state.v.detach(), state.contact_force.detach(), *grads]


@pytest.mark.parametrize("method", ["auto", "newton_pcg", "newton_cholesky"])
def test_threads_and_repetition(method):
    first = run(method=method)
    for other in (run(method=method), run(method=method, threads=2)):
        assert all(torch.equal(a, b) for a, b in zip(first, other, strict=True))


def test_threads_on_one_item_of_many_nodes():
    """One item uses all threads inside its kernels; 600 nodes are several tasks."""
    first, second = (run((1,), threads, cells=(9, 9, 5)) for threads in (1, 2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_batch_and_single():
    """Also from a cold start: what one step caches must not change the next one's bits."""
    whole = run()
    for k in range(3):
        single = run((k,))
        assert all(torch.equal(a[k], b[0]) for a, b in zip(whole, single, strict=True))
