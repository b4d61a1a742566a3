"""Are the derivatives of a layer right? Along random directions, at a few evaluations an input.

`torch.autograd.gradcheck` calls a layer four times an input or more, most of them to ask what
happens to gradients that are not there: that is a question to the ops, and
`tests.helpers.check_layer` asks it of each. Here only numbers are compared.
"""

from collections.abc import Callable, Iterable, Sequence

import torch
import torch.autograd.forward_ad as forward_mode
from torch import Tensor


def check_directions(
    layer: Callable[..., Tensor | Sequence[Tensor]],
    args: Sequence[Tensor],
    *,
    eps: float = 1e-6,
    atol: float = 1e-5,
    rtol: float = 1e-3,
    check_forward_ad: bool = False,
    seeds: Iterable[int] = (0,),
) -> None:
    """Compare the adjoint, and forward mode, with central differences.

    For each seed every input moves alone along normal numbers (not of unit length: an error of one
    entry of the Jacobian shows with the size that it has), and outputs are weighed by normal
    numbers. Forward mode moves every other input at once, then the rest, and is compared in each
    output; so ops see directions that are missing.

    Args:
        layer: Function of ``args`` that returns a tensor, or several.
        args: Its arguments; those checked require gradients.
        eps: Half the distance of the differences.
        atol: Absolute tolerance, as in ``torch.autograd.gradcheck``.
        rtol: Relative tolerance.
        check_forward_ad: Forward mode too.
        seeds: One comparison for each.
    """
    moved = [k for k, a in enumerate(args) if isinstance(a, Tensor) and a.requires_grad]
    assert moved, "no argument requires a gradient"
    for seed in seeds:
        random = torch.Generator().manual_seed(seed)
        directions = {k: _normal(args[k], random) for k in moved}
        out = _flat(layer(*args))
        weight = _normal(out, random)
        slopes = {k: _difference(layer, args, k, directions[k], eps) for k in moved}
        inputs = [args[k] for k in moved]
        grads = torch.autograd.grad(out, inputs, weight, allow_unused=True)
        for k, grad in zip(moved, grads, strict=True):
            found = torch.zeros(()) if grad is None else (grad * directions[k]).sum()
            _assert_close(found, (weight * slopes[k]).sum(), atol, rtol, f"adjoint, argument {k}")
        for some in (moved[::2], moved[1::2]) if check_forward_ad else ():
            if some:
                found = _forward(layer, args, {k: directions[k] for k in some})
                expected = torch.stack([slopes[k] for k in some]).sum(0)
                _assert_close(found, expected, atol, rtol, f"forward mode, arguments {some}")


def _normal(like: Tensor, random: torch.Generator) -> Tensor:
    return torch.randn(like.shape, generator=random, dtype=like.dtype)


def _flat(out: Tensor | Sequence[Tensor]) -> Tensor:
    outs = [out] if isinstance(out, Tensor) else out
    return torch.cat([o.flatten() for o in outs])


def _difference(layer, args, k: int, direction: Tensor, eps: float) -> Tensor:
    """Central difference of the outputs, input ``k`` moving along ``direction``."""
    ends = []
    with torch.no_grad():
        for step in (eps, -eps):
            given = [a.detach() if isinstance(a, Tensor) else a for a in args]
            given[k] = given[k] + step * direction
            ends.append(_flat(layer(*given)))
    return (ends[0] - ends[1]) / (2.0 * eps)


def _forward(layer, args, directions: dict[int, Tensor]) -> Tensor:
    """Forward mode along ``directions`` together."""
    with forward_mode.dual_level():
        given = [a.detach() if isinstance(a, Tensor) else a for a in args]
        for k, direction in directions.items():
            given[k] = forward_mode.make_dual(given[k], direction)
        primal, tangent = forward_mode.unpack_dual(_flat(layer(*given)))
        return torch.zeros_like(primal) if tangent is None else tangent.clone()


def _assert_close(found: Tensor, expected: Tensor, atol: float, rtol: float, what: str) -> None:
    expected = expected.to(found.dtype)
    torch.testing.assert_close(
        found, expected, atol=atol, rtol=rtol, msg=lambda text: f"{what}: {text}"
    )
