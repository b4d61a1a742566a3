"""Derivatives of derivatives: in every order of modes, against differences of gradients."""

import pytest
import torch
from torch import Tensor
from torch.func import grad, jacfwd, jacrev

from diffsim.ode import Ode, _ops
from tests.ode.test_integrate import EVERY_OPERATION, given

pytestmark = pytest.mark.grad
SYSTEM = Ode(
    rates={"x": "v", "v": "-k*sin(x) - c*v*abs(v) + u*x + 0.1*w"},
    readings={"y": "x + 0.1*v**2*k + w*u"},
    parameters=["k", "c"],
    inputs=["u", "w"],
    held=["w"],
    limits={"x": (-0.2, 0.42)},
)
TIMES = torch.linspace(0.0, 1.0, 5, dtype=torch.float64)


def loss(z: Tensor) -> Tensor:
    """Of start (2), inputs (5, 2) and parameters (2); x meets its upper limit."""
    readings, states = SYSTEM.solve(TIMES, z[:2], z[2:12].reshape(5, 2), z[12:], num_steps=2)
    return readings.pow(3).sum() + states[-1].square().prod() + states.square().sum()


def some_point() -> Tensor:
    inputs = torch.stack([TIMES.sin(), TIMES.cos()], -1)
    numbers = [torch.tensor([0.4, 0.3]), inputs.flatten(), torch.tensor([3.0, 0.4])]
    return torch.cat([part.double() for part in numbers])


def hessian_by_differences(z: Tensor) -> Tensor:
    slope, step = grad(loss), 1e-5
    ways = step * torch.eye(len(z), dtype=torch.float64)
    return torch.stack([(slope(z + w) - slope(z - w)) / (2.0 * step) for w in ways])


@pytest.mark.parametrize("outer", [jacrev, jacfwd])
@pytest.mark.parametrize("inner", [jacrev, jacfwd])
def test_hessians_in_every_order_of_modes(outer, inner):
    z = some_point()
    torch.testing.assert_close(outer(inner(loss))(z), hessian_by_differences(z), rtol=0, atol=1e-8)


@pytest.mark.parametrize("batched", [False, True])
def test_hessians_and_products_of_torch_autograd(batched):
    z, expected = some_point(), hessian_by_differences(some_point())
    found = torch.autograd.functional.hessian(loss, z, vectorize=batched)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-8)
    way = torch.linspace(-1.0, 1.0, len(z), dtype=torch.float64)
    leaf = z.clone().requires_grad_()
    (slope,) = torch.autograd.grad(loss(leaf), leaf, create_graph=True)
    (product,) = torch.autograd.grad(slope @ way, leaf)
    torch.testing.assert_close(product, expected @ way, rtol=0, atol=1e-8)


def test_third_derivatives():
    system = Ode(rates={"x": "-k*x"}, readings={"y": "x"}, parameters=["k"])
    start = torch.ones(1, dtype=torch.float64)

    def end(k: Tensor) -> Tensor:
        return system.solve(TIMES, start, None, k[None], num_steps=20)[0][-1, 0]

    k = torch.tensor(0.7, dtype=torch.float64)
    third = grad(grad(grad(end)))(k)
    torch.testing.assert_close(third, -(-k).exp(), rtol=1e-6, atol=0)


@pytest.mark.parametrize("shared", [False, True])
def test_steps_in_torch_are_those_of_the_kernel(shared):
    """Every operation, limits, held inputs, shared ones, a batch."""
    times, (start, inputs, parameters) = given(3, shared=shared)
    expected = EVERY_OPERATION.solve(times, start, inputs, parameters, num_steps=3)
    problem = EVERY_OPERATION.problem(times, 3, 1)
    one_more = inputs if inputs.ndim == 3 else inputs[None]
    found = _ops.solve(problem, 3, start.expand(3, -1), one_more, parameters.expand(3, -1))
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-13)
