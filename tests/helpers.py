"""The contract that every differentiable layer keeps; called once for each. Numbers of tests."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.core.ops import Op
from tests.gradients import check_directions


def check_layer(
    layer: Callable[..., Tensor],
    args: Sequence[Any],
    *,
    ops: Sequence[tuple[Any, ...]],
    fast_mode: bool = False,
    **gradcheck_options: Any,
) -> None:
    """Check a layer's ops, that its gradient is not zero and is right, and that it compiles.

    Args:
        layer: Function of ``args`` that returns one tensor.
        args: Its arguments; those to be checked require gradients.
        ops: The custom ops behind it with arguments for each, ``(op, op_args)`` or
            ``(op, op_args, op_kwargs)``.
        fast_mode: Differences along random directions in place of the full Jacobian.
        **gradcheck_options: Passed to ``torch.autograd.gradcheck`` (``eps``, ``atol``, ...).
    """
    for op, *given in ops:  # schema, fake kernel, aliasing
        torch.library.opcheck(op, *given)
    out = layer(*args)
    # not all ones: internal forces sum to zero, and so would their gradient
    cotangent = torch.linspace(1, 2, out.numel(), dtype=out.dtype).view_as(out)
    inputs = [a for a in args if isinstance(a, Tensor) and a.requires_grad]
    assert inputs, "no argument requires a gradient"
    grads = torch.autograd.grad(out, inputs, cotangent)
    assert all(g.abs().max() > 0 for g in grads)  # or gradcheck proves nothing
    again = torch.autograd.grad(layer(*args), inputs, cotangent)
    assert all(torch.equal(one, other) for one, other in zip(grads, again, strict=True))
    options = {"check_forward_ad": True, **gradcheck_options}
    if fast_mode:
        check_directions(layer, args, seeds=(0, 1), **options)
    else:
        assert torch.autograd.gradcheck(layer, args, **options)
    whole = torch.compile(layer, fullgraph=True, backend="aot_eager")
    compiled = whole(*args)
    torch.testing.assert_close(compiled, out)
    compiled_grads = torch.autograd.grad(compiled, inputs, cotangent)
    torch.testing.assert_close(compiled_grads, grads)


def with_derivatives(op: Op, *args: Any) -> list[tuple[Any, tuple[Any, ...]]]:
    """A row's op and those of its derivatives, each with arguments, for :func:`check_layer`."""
    found = op.op(*args)
    outputs = found if isinstance(found, tuple) else (found,)
    known = dict(zip((*op.arguments, *op.outputs), (*args, *outputs), strict=True))
    known = {n: v.detach() if isinstance(v, Tensor) else v for n, v in known.items()}
    checks = [(op.op, args)]
    for row in filter(None, (op.vjp, op.jvp)):
        # along ones: what a name with a prefix is has the shape of what it is without
        given = [
            known[n] if n in known else torch.ones_like(_bare(known, n)) for n in row.arguments
        ]
        checks.append((row.op, tuple(given)))
    return checks


def _bare(known: dict[str, Any], name: str) -> Tensor:
    return known[
        name.removeprefix("grad_") if name.startswith("grad_") else name.removeprefix("d_")
    ]


def tensor(values):
    return torch.tensor(values, dtype=torch.float64)


def numbers(*values):
    return tensor(values)


def random(seed: int, *shape: int):
    """Drawn evenly from 0 to 1."""
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def at_rest(x):
    """A soft body in places, without speed."""
    from diffsim import soft

    return soft.State(x, torch.zeros_like(x))


def observed_order(h, error):
    """Slope of log(error) over log(h)."""
    return np.polyfit(np.log(h), np.log(error), 1)[0]
