"""A kernel as a layer: both modes, mapped axes, and refusals instead of silent zeros."""

from __future__ import annotations

import sys

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode
from torch.func import grad, jacfwd, jacrev, jvp, vjp, vmap
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils._python_dispatch import TorchDispatchMode

from diffsim.core.layer import is_kernel_alone, make_first_order, make_layer


@torch.library.custom_op("diffsim_test::power_sum", mutates_args=())
def power_sum(
    x: Tensor, others: list[Tensor], exponent: int, *, scale: float
) -> tuple[Tensor, Tensor]:
    """scale x^exponent + the sum of the others, and a count without derivative."""
    total = scale * x.pow(exponent)
    for other in others:
        total = total + other
    return total, torch.tensor(float(len(others)))


@power_sum.register_fake
def _(x, others, exponent, *, scale):
    return torch.empty_like(x), torch.empty((), dtype=torch.float32)


@torch.library.custom_op("diffsim_test::power_slope", mutates_args=())
def power_slope(g: Tensor, x: Tensor, exponent: int, scale: float) -> list[Tensor]:
    """g times the slope of the power, in a list as adjoints return theirs."""
    return [g * (scale * exponent * x.pow(exponent - 1))]


@power_slope.register_fake
def _(g, x, exponent, scale):
    return [torch.empty_like(x)]


slope = make_first_order(power_slope)


def _setup(ctx, inputs, keyword_only_inputs, output):
    x, others, ctx.exponent = inputs
    ctx.scale, ctx.count = keyword_only_inputs["scale"], len(others)
    ctx.save_for_backward(x)
    ctx.mark_non_differentiable(output[1])


def _backward(ctx, g, _):
    (x,) = ctx.saved_tensors
    return slope(g.contiguous(), x, ctx.exponent, ctx.scale)[0], [g] * ctx.count, None


def _tangent(ctx, dx, d_others, _):
    (x,) = ctx.saved_tensors
    total = torch.zeros_like(x) if dx is None else slope(dx, x, ctx.exponent, ctx.scale)[0]
    for d in d_others:
        total = total if d is None else total + d
    return total, None


layer = make_layer(power_sum, setup=_setup, backward=_backward, tangent=_tangent)
A, B = torch.tensor([1.0, 2.0, -3.0]).double(), torch.tensor([0.5, 0.1, 0.2]).double()


def cube(a, b):
    return layer(a, [b, b], 3, scale=2.0)[0]


def test_reverse_and_forward_mode_agree_with_the_closed_form():
    tangent = torch.tensor([1.0, -1.0, 0.5]).double()
    out, moved = jvp(cube, (A, B), (tangent, 2.0 * tangent))
    torch.testing.assert_close(out, 2.0 * A**3 + 2.0 * B)
    torch.testing.assert_close(moved, 6.0 * A**2 * tangent + 4.0 * tangent)
    g_a, g_b = vjp(cube, A, B)[1](tangent)
    torch.testing.assert_close(g_a, 6.0 * A**2 * tangent)
    torch.testing.assert_close(g_b, 2.0 * tangent)
    torch.testing.assert_close(grad(lambda a: cube(a, B).sum())(A), 6.0 * A**2)


def test_jacobians_of_both_modes_are_diagonal():
    for made in (jacrev(cube), jacfwd(cube)):
        torch.testing.assert_close(made(A, B), torch.diag(6.0 * A**2))


def test_a_mapped_axis_may_be_any_and_in_lists_too():
    rows = torch.stack([A, 2.0 * A], dim=1)
    mapped = vmap(cube, in_dims=(1, None))(rows, B)
    torch.testing.assert_close(mapped, torch.stack([cube(A, B), cube(2.0 * A, B)]))
    others = torch.stack([B, 3.0 * B])
    mapped = vmap(cube, in_dims=(None, 0))(A, others)
    torch.testing.assert_close(mapped, torch.stack([cube(A, B), cube(A, 3.0 * B)]))


def test_gradients_and_tangents_come_in_batches_of_pytorch_s_older_kind():
    a, b = A.clone().requires_grad_(), B.clone().requires_grad_()
    options = {"check_forward_ad": True, "check_batched_forward_grad": True}
    assert torch.autograd.gradcheck(cube, (a, b), check_batched_grad=True, **options)


def test_past_the_dispatcher_only_where_nothing_has_to_see_the_call(monkeypatch):
    """Without gradients the kernel is called alone; who follows calls still sees the op."""
    seen = []

    class Watch(TorchDispatchMode):
        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            seen.append(str(func))
            return func(*args, **(kwargs or {}))

    with torch.no_grad():
        with monkeypatch.context() as patch:
            patch.delitem(sys.modules, "torch._dynamo", raising=False)  # of an earlier test
            assert is_kernel_alone([A, B]) and not is_kernel_alone([A.to("meta")])
            plain = cube(A, B)
        assert torch.equal(plain, cube(A.clone().requires_grad_(), B))
        with Watch():
            assert torch.equal(cube(A, B), plain)
        assert any("power_sum" in name for name in seen)
        with FakeTensorMode() as mode:
            assert type(cube(mode.from_tensor(A), mode.from_tensor(B))) is FakeTensor
        rows = torch.stack([A, 2.0 * A])
        torch.testing.assert_close(
            vmap(cube, in_dims=(0, None))(rows, B), torch.stack([plain, cube(2.0 * A, B)])
        )
        traced = make_fx(cube)(A, B)
        assert any("power_sum" in str(node.target) for node in traced.graph.nodes)
        mirrored = torch.complex(A, A).conj().imag  # a view whose sign is not in its memory
        assert mirrored.is_neg()
        torch.testing.assert_close(cube(mirrored, B), -2.0 * A**3 + 2.0 * B)


def test_arguments_may_be_named():
    named = layer(others=[B], exponent=2, x=A, scale=1.0)[0]
    torch.testing.assert_close(named, A**2 + B)


def test_second_derivatives_are_refused_in_every_order():
    def total(a):
        return cube(a, B).sum()

    with pytest.raises(NotImplementedError, match="second order"):
        grad(lambda a: grad(total)(a).sum())(A)
    with pytest.raises(NotImplementedError, match="second order"):
        jvp(grad(total), (A,), (A,))
    with pytest.raises(NotImplementedError, match="second order"):
        jacfwd(lambda a: jvp(total, (a,), (A,))[1])(A)
    leaf = A.clone().requires_grad_()
    (first,) = torch.autograd.grad(total(leaf), leaf, create_graph=True)
    with pytest.raises(NotImplementedError, match="second order"):
        torch.autograd.grad(first.sum(), leaf)


@torch.library.custom_op("diffsim_test::doubled", mutates_args=())
def doubled(x: Tensor) -> Tensor:
    """Twice x."""
    return 2.0 * x


@doubled.register_fake
def _(x):
    return torch.empty_like(x)


reverse_only = make_layer(
    doubled, setup=lambda ctx, inputs, output: None, backward=lambda ctx, g: 2.0 * g
)


def test_forward_mode_is_refused_where_it_is_not_known():
    with pytest.raises(NotImplementedError, match=r"doubled has no forward-mode derivative"):
        jvp(reverse_only, (A,), (A,))
    # what a custom op alone would answer: zero, without a word
    torch.testing.assert_close(jvp(lambda a: a + reverse_only(B), (A,), (A,))[1], A)


def test_a_layer_compiles_whole():
    whole = torch.compile(cube, fullgraph=True, backend="aot_eager")
    leaf = A.clone().requires_grad_()
    out = whole(leaf, B)
    torch.testing.assert_close(out, cube(A, B))
    torch.testing.assert_close(torch.autograd.grad(out.sum(), leaf)[0], 6.0 * A**2)
