"""A kernel as a layer: both modes, mapped axes, and refusals instead of silent zeros."""

import sys

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode
from torch.func import grad, jacfwd, jacrev, jvp, vjp, vmap
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils._python_dispatch import TorchDispatchMode

from diffsim.core.layer import is_kernel_alone
from diffsim.core.ops import Call, Op, array
from tests.helpers import with_derivatives


def _power_sum(call: Call) -> None:
    """scale x^exponent + two others, and a count without derivative."""
    scale, exponent = call.options["scale"], call.options["exponent"]
    call["total"].copy_(scale * call["x"].pow(exponent) + call["one"] + call["other"])
    call["count"].fill_(2)


def _slope(call: Call) -> torch.Tensor:
    scale, exponent = call.options["scale"], call.options["exponent"]
    return scale * exponent * call["x"].pow(exponent - 1)


def _adjoint(call: Call) -> None:
    call["grad_x"] += call["grad_total"] * _slope(call)
    for name in ("grad_one", "grad_other"):
        call[name] += call["grad_total"]


def _tangent(call: Call) -> None:
    call["d_total"].copy_(call["d_x"] * _slope(call) + call["d_one"] + call["d_other"])


layer = Op(
    "test_power_sum",
    inputs=dict.fromkeys(("x", "one", "other"), array("size")),
    outputs={"total": array("size"), "count": array(dtype=torch.int64, smooth=False)},
    options="int exponent, float scale",
    kernel=_power_sum,
    adjoint=_adjoint,
    tangent=_tangent,
)
A, B = torch.tensor([1.0, 2.0, -3.0]).double(), torch.tensor([0.5, 0.1, 0.2]).double()


def cube(a, b):
    return layer(a, b, b, 3, scale=2.0)[0]


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


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_mapped_axis_may_be_any_and_of_any_length(count):
    many = [k * A for k in range(1, count + 1)]
    mapped = vmap(cube, in_dims=(1, None))(torch.stack(many, dim=1), B)
    torch.testing.assert_close(mapped, torch.stack([cube(a, B) for a in many]))
    mapped = vmap(cube, in_dims=(None, 0))(B, torch.stack(many))
    torch.testing.assert_close(mapped, torch.stack([cube(B, a) for a in many]))


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
    named = layer(other=B, one=B, exponent=2, x=A, scale=1.0)[0]
    torch.testing.assert_close(named, A**2 + 2.0 * B)


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


def test_a_row_and_its_derivatives_are_ops_of_pytorch():
    for op, args in with_derivatives(layer, A.clone().requires_grad_(), B, B, 3, 2.0):
        torch.library.opcheck(op, args)


@pytest.mark.parametrize(
    ("bad", "error", "message"),
    [
        (B[:2], ValueError, r"other must have shape \(3,\), got \(2,\)"),
        (B[None], ValueError, r"other must have shape \(3,\), got \(1, 3\)"),
        (B.float(), TypeError, "other must be a torch.float64 CPU tensor, got torch.float32"),
    ],
)
def test_what_a_kernel_could_not_read_is_refused(bad, error, message):
    with pytest.raises(error, match=message):
        layer(A, B, bad, 3, 2.0)


def test_a_kernel_reads_rows_without_gaps():
    wide = torch.stack([A, B], dim=1)
    torch.testing.assert_close(layer(wide[:, 0], wide[:, 1], B, 3, 2.0)[0], cube(A, B))


def test_a_layer_compiles_whole():
    whole = torch.compile(cube, fullgraph=True, backend="aot_eager")
    leaf = A.clone().requires_grad_()
    out = whole(leaf, B)
    torch.testing.assert_close(out, cube(A, B))
    torch.testing.assert_close(torch.autograd.grad(out.sum(), leaf)[0], 6.0 * A**2)
