"""One way to make a kernel a differentiable function of PyTorch, in reverse and in forward mode.

A custom op alone has no forward mode: PyTorch takes its derivative for zero, without a word. A
:class:`torch.autograd.Function` has one, but the compiler of PyTorch refuses to trace it. So a
layer is both: the op where PyTorch compiles, the function everywhere else. Where neither a
derivative nor anything else of PyTorch is asked for, it is the kernel alone: for small systems the
way through the dispatcher takes longer than the kernel.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from diffsim.core import torch_names
from diffsim.core.torch_names import stands_for_many

_PLAIN = (Tensor, torch.nn.Parameter)
NO_SECOND_ORDER = (
    "{name} is a derivative that cannot be differentiated again: derivatives of second order are "
    "not available here; differentiate once, without create_graph=True"
)


def custom_op(name: str, schema: str | None = None) -> Callable[[Callable[..., Any]], Any]:
    """Decorator as ``torch.library.custom_op``, for ops that change none of their arguments, and
    without PyTorch's compiler where nobody compiles.

    Args:
        name: Name of the op with its namespace, such as "diffsim::flight".
        schema: Arguments and results as PyTorch writes them; None: read from the annotations.
    """

    def made(kernel: Callable[..., Any]) -> Any:
        op = torch.library.custom_op(name, kernel, mutates_args=(), schema=schema)
        torch_names.call_past_compiler(op, kernel)
        return op

    return made


def outside_of_graphs(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that ``torch.compile`` leaves alone, with all that it calls.

    As ``torch.compiler.disable``, which imports the compiler; where nobody has, nobody compiles.
    """
    return torch.compiler.disable(function) if torch_names.has_compiler() else function


def make_layer(
    name: str,
    op: Any,
    kernel: Callable[..., Any],
    arguments: Sequence[str],
    *,
    setup: Callable[..., None],
    backward: Callable[..., Any],
    tangent: Callable[..., Any],
) -> Callable[..., Any]:
    """A function that calls an op and has its derivatives in both modes.

    Args:
        name: What errors of PyTorch call it.
        op: A custom op of ``torch.library`` without lists of tensors.
        arguments: Names of the op's arguments, in order.
        setup: As ``setup_context`` of ``torch.library``: (ctx, inputs, output).
        backward: As ``backward`` of ``torch.library``: one gradient for every input.
        tangent: Takes ctx and the tangents of the inputs (None where one does not move) and returns
            those of the outputs (None where an output has no derivative). It reads
            ``ctx.saved_tensors`` as backward does.

    Returns:
        A function with the arguments of the op. ``torch.func.vmap`` calls the op item by item.
    """
    op.register_autograd(backward, setup_context=setup)

    def rule(info: Any, in_dims: Sequence[Any], *args: Any) -> Any:
        return _one_by_one(op, info.batch_size, in_dims, args)

    op.register_vmap(rule)

    def set_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        setup(ctx, inputs, output)
        ctx.save_for_forward(*(ctx.to_save or ()))

    def each_backward(ctx: Any, *grads: Any) -> Any:
        return also_item_by_item(lambda *given: backward(ctx, *given), grads)

    def each_tangent(ctx: Any, *moved: Any) -> Any:
        return also_item_by_item(lambda *given: tangent(ctx, *given), moved)

    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> Any:
        return _one_by_one(function.apply, info.batch_size, in_dims, args)

    def forward(*args: Any) -> Any:
        return run(*args)

    forward.__signature__ = inspect.signature(forward)  # type: ignore[attr-defined]
    members: dict[str, Callable[..., Any]] = {
        "forward": forward,  # PyTorch asks for its signature at every call, 7 us if not kept
        "setup_context": set_context,
        "backward": each_backward,
        "jvp": each_tangent,
        "vmap": vmap,
    }
    statics = {member: staticmethod(made) for member, made in members.items()}
    function: Any = type(name, (torch.autograd.Function,), statics)

    def layer(*args: Any, **named: Any) -> Any:
        if named:
            args = (*args, *(named[name] for name in arguments[len(args) :]))
        if torch.compiler.is_compiling():
            return op(*args)
        if may_be_differentiated() and _is_differentiated(args):
            return function.apply(*args)
        return run(*args)

    def run(*args: Any) -> Any:
        """The kernel alone where nothing of PyTorch has to see the call, else the op."""
        alone = not torch_names.is_watched() and not _is_transformed() and _are_plain(args)
        return (kernel if alone else op)(*args)

    layer.__name__ = layer.__qualname__ = name
    return layer


def _is_differentiated(row: Iterable[Any]) -> bool:
    """Whether a derivative or a mapping is asked for; if none is, the op alone is faster."""
    return _is_transformed() or any(
        isinstance(value, Tensor) and value.requires_grad for value in row
    )


def may_be_differentiated() -> bool:
    """Whether a derivative of what is computed now could be asked for."""
    return torch.is_grad_enabled() or _is_transformed()


def is_kernel_alone(tensors: Sequence[Tensor]) -> bool:
    """Whether a kernel may be called past PyTorch: nothing of it has to see that call."""
    if torch.compiler.is_compiling() or torch_names.is_watched() or not _are_plain(tensors):
        return False
    return not is_followed(tensors)


def is_followed(tensors: Sequence[Tensor]) -> bool:
    """Whether a derivative by one of some tensors, or a mapping, may be asked for now."""
    return may_be_differentiated() and _is_differentiated(tensors)


def is_recorded_plainly(tensors: Sequence[Tensor]) -> bool:
    """Whether a gradient by one of some tensors is recorded, and nothing else follows the calls."""
    if torch.compiler.is_compiling() or _is_transformed():
        return False
    if torch_names.is_watched(by_compilers=False):
        return False
    return torch.is_grad_enabled() and _are_plain(tensors) and _is_differentiated(tensors)


def _are_plain(values: Iterable[Any]) -> bool:
    """Whether all tensors among arguments are what their memory says."""
    return all(
        type(value) in _PLAIN and value.is_cpu and not value.is_neg()
        for value in values
        if isinstance(value, Tensor)
    )


def _is_transformed() -> bool:
    return torch_names.is_in_func() or torch_names.is_in_forward_mode()


def first_order(name: str, answer: Tensor, gradients: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Gradients, which refuse to be differentiated again.

    Args:
        name: What the refusal calls them.
        answer: Output of the node whose backward this is, of which they are functions.
        gradients: Computed without a graph.
    """
    if not torch.is_grad_enabled():
        return gradients
    out: tuple[Tensor, ...] = _FirstOrder.apply(name, answer, *gradients)
    return out


class _FirstOrder(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, name: str, answer: Tensor, *gradients: Tensor) -> tuple[Tensor, ...]:
        ctx.name = name
        return tuple(gradient.view_as(gradient) for gradient in gradients)

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> Any:
        raise NotImplementedError(NO_SECOND_ORDER.format(name=ctx.name))


def _one_by_one(
    one: Callable[..., Any], count: int, in_dims: Sequence[Any], args: Sequence[Any]
) -> tuple[Any, Any]:
    """Outputs of every item of a mapped axis, stacked on axis 0, and where that axis is."""
    items = [
        one(*(_item(value, dim, k) for value, dim in zip(args, in_dims, strict=True)))
        for k in range(count)
    ]
    if isinstance(items[0], Tensor):
        return torch.stack(items), 0
    stacked = tuple(s[0] if s[0] is None else torch.stack(s) for s in zip(*items, strict=True))
    return stacked, (0,) * len(stacked)


def also_item_by_item(one: Callable[..., Any], args: tuple[Any, ...]) -> Any:
    """What a derivative gives, of every item where PyTorch batches without a transform.

    ``is_grads_batched``, ``jacobian(vectorize=True)`` and gradcheck hand one tensor that stands for
    many and has no memory of its own, past the rules of ``torch.func.vmap``.
    """
    if not any(isinstance(value, Tensor) and stands_for_many(value) for value in args):
        return one(*args)
    inner, dims, closed = torch_names.opened(args)
    count = next(len(value) for value, dim in zip(inner, dims, strict=True) if dim == 0)
    stacked, _ = _one_by_one(one, count, dims, inner)
    if isinstance(stacked, Tensor):
        return closed(stacked)
    return tuple(s if s is None else closed(s) for s in stacked)


def _item(value: Any, dim: Any, k: int) -> Any:
    if dim is None or not isinstance(value, Tensor):  # lists of numbers have a dim for each
        return value
    return value.select(dim, k).contiguous()
