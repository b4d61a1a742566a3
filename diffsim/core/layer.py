"""One way to make a kernel a differentiable function of PyTorch, in reverse and in forward mode.

A custom op alone has no forward mode: PyTorch takes its derivative for zero, without a word. A
:class:`torch.autograd.Function` has one, but the compiler of PyTorch refuses to trace it. So a
layer is both: the op where PyTorch compiles, the function everywhere else. Where neither a
derivative nor anything else of PyTorch is asked for, it is the kernel alone: for small systems the
way through the dispatcher takes longer than the kernel.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad

_PLAIN = (Tensor, torch.nn.Parameter)
_stands_for_many = torch._C._functorch.is_legacy_batchedtensor


def custom_op(name: str) -> Callable[[Callable[..., Any]], Any]:
    """Decorator as ``torch.library.custom_op``, for ops that change none of their arguments.

    Torch wraps the kernel so that its compiler leaves it alone, and imports the compiler for it:
    more than a second of every process, mostly of sympy. Where nobody compiles, the kernel is
    called as it is.

    Args:
        name: Name of the op with its namespace, such as "diffsim::flight".
    """

    def made(kernel: Callable[..., Any]) -> Any:
        op = torch.library.custom_op(name, kernel, mutates_args=())
        kernels = getattr(op, "_backend_fns", {})  # torch's own; without it all is as before
        wrapped = kernels.get(None)
        if wrapped is not None:

            def run(*args: Any, **named: Any) -> Any:
                is_compiling = "torch._dynamo" in sys.modules
                return (wrapped if is_compiling else kernel)(*args, **named)

            kernels[None] = run
        return op

    return made


def outside_of_graphs(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that ``torch.compile`` leaves alone, with all that it calls.

    As ``torch.compiler.disable``, which imports the compiler; where nobody has, nobody compiles.
    """
    return torch.compiler.disable(function) if "torch._dynamo" in sys.modules else function


@contextmanager
def on_constants() -> Iterator[None]:
    """A block, or as a decorator a function, that ``torch.func`` does not look into.

    There, even a plain tensor's memory is refused. For what is made of constants only, such as a
    mesh.
    """
    with torch._C._DisableFuncTorch():  # PyTorch has no public name
        yield


class Call(NamedTuple):
    """How the flat arguments of a function become those of an op.

    Attributes:
        lengths: Number of tensors of every positional argument that is a list; None: no list.
        options: Keyword-only arguments, none of them a tensor.
    """

    lengths: tuple[int | None, ...]
    options: Mapping[str, Any]

    @classmethod
    def of(cls, args: Sequence[Any], options: Mapping[str, Any]) -> Call:
        """The structure of a call."""
        return cls(tuple(len(a) if isinstance(a, list) else None for a in args), options)

    def flat(self, args: Any) -> list[Any]:
        """The arguments in a row, of a tuple or alone; None for a list stands for as many None."""
        row: list[Any] = []
        each = args if isinstance(args, tuple) else (args,)
        for length, value in zip(self.lengths, each, strict=True):
            if length is None:
                row.append(value)
            else:
                row.extend([None] * length if value is None else value)
        return row

    def nested(self, row: Sequence[Any]) -> list[Any]:
        """The arguments of the op."""
        args: list[Any] = []
        at = 0
        for length in self.lengths:
            args.append(row[at] if length is None else list(row[at : at + length]))
            at += 1 if length is None else length
        return args


def make_layer(
    op: Any,
    *,
    setup: Callable[..., None],
    backward: Callable[..., Any],
    tangent: Callable[..., Any] | None = None,
) -> Callable[..., Any]:
    """A function that calls an op and has its derivatives in both modes.

    Backward and tangent call further ops as :func:`make_first_order` returns them: so a second
    derivative raises instead of being wrong.

    Args:
        op: A custom op of ``torch.library``. Positional arguments are tensors, numbers, text or
            lists of tensors; keyword-only ones are no tensors.
        setup: As ``setup_context`` of ``torch.library``: (ctx, inputs, output), or (ctx, inputs,
            keyword_only_inputs, output) where the op has keyword-only arguments.
        backward: As ``backward`` of ``torch.library``: one gradient for every positional input,
            lists for lists, None where there is none.
        tangent: Takes ctx and the tangents of the positional inputs (lists for lists, None where an
            input does not move) and returns those of the outputs (None where an output has no
            derivative). It reads ``ctx.saved_tensors`` as backward does. None: refused.

    Returns:
        A function with the arguments of the op. ``torch.func.vmap`` calls the op item by item.
    """
    op.register_autograd(backward, setup_context=setup)
    name = _name(op)

    def set_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.call, *row = inputs
        args = tuple(ctx.call.nested(row))
        if ctx.call.options:
            setup(ctx, args, ctx.call.options, output)
        else:
            setup(ctx, args, output)
        ctx.save_for_forward(*(ctx.to_save or ()))

    def flat_backward(ctx: Any, *grads: Any) -> tuple[Any, ...]:
        if any(isinstance(g, Tensor) and _stands_for_many(g) for g in grads):
            return None, *_item_by_item(lambda *g: ctx.call.flat(backward(ctx, *g)), grads)
        return None, *ctx.call.flat(backward(ctx, *grads))

    def flat_tangent(ctx: Any, _call: None, *row: Any) -> Any:
        if tangent is None:
            raise NotImplementedError(
                f"{name} has no forward-mode derivative; use reverse mode (backward, "
                "torch.func.grad, vjp, jacrev)"
            )
        if any(isinstance(d, Tensor) and _stands_for_many(d) for d in row):
            return _item_by_item(lambda *given: tangent(ctx, *ctx.call.nested(given)), row)
        return tangent(ctx, *ctx.call.nested(row))

    return _callable(op, set_context, flat_backward, flat_tangent)


def directions_of(
    inputs: Mapping[str, Tensor], moved: Sequence[Tensor | None]
) -> dict[str, Tensor]:
    """Directions of inputs as an op of the tangent takes them, by ``d_NAME``.

    Args:
        inputs: Inputs by name, in the order of the layer.
        moved: Their directions, in that order; None where one does not move: zeros. What follows
            them belongs to options.
    """
    return {
        f"d_{name}": torch.zeros_like(value) if direction is None else direction
        for (name, value), direction in zip(inputs.items(), moved, strict=False)
    }


def make_first_order(op: Any) -> Callable[..., Any]:
    """A function that calls an op whose derivative is not known, and raises where one is asked for.

    For ops that are derivatives themselves. Without it PyTorch takes the derivative for zero.

    Args:
        op: As for :func:`make_layer`.

    Returns:
        A function with the arguments of the op.
    """
    message = (
        f"{_name(op)} is a derivative that cannot be differentiated again: derivatives of second "
        "order are not available here; differentiate once, without create_graph=True"
    )

    def refuse(*_: Any) -> Any:
        raise NotImplementedError(message)

    return _callable(op, lambda ctx, inputs, output: None, refuse, refuse)


def _callable(
    op: Any,
    setup: Callable[..., None],
    backward: Callable[..., Any],
    tangent: Callable[..., Any],
) -> Callable[..., Any]:
    """An op with derivatives in both modes and an axis to map, called as the op is.

    Args:
        op: Op that is called.
        setup, backward, tangent: Of a :class:`torch.autograd.Function` of a :class:`Call` and the
            arguments in a row.
    """

    def rule(info: Any, in_dims: Sequence[Any], *args: Any, **options: Any) -> Any:
        return _one_by_one(lambda *at: op(*at, **options), info.batch_size, in_dims, args)

    op.register_vmap(rule)

    def forward(call: Call, *row: Any) -> Any:
        out = run(*call.nested(row), **call.options)
        return tuple(out) if isinstance(out, list) else out  # tensors of a list are not followed

    def vmap(info: Any, in_dims: tuple[Any, ...], call: Call, *row: Any) -> Any:
        return _one_by_one(lambda *at: kind.apply(call, *at), info.batch_size, in_dims[1:], row)

    forward.__signature__ = inspect.signature(forward)  # type: ignore[attr-defined]
    members: dict[str, Callable[..., Any]] = {
        "forward": forward,  # PyTorch asks for its signature at every call, 7 us if not kept
        "setup_context": setup,
        "backward": backward,
        "jvp": tangent,
        "vmap": vmap,
    }
    kind: Any = type(
        _name(op),
        (torch.autograd.Function,),
        {name: staticmethod(member) for name, member in members.items()},
    )
    arguments = op._opoverload._schema.arguments
    by_place = [a.name for a in arguments if not a.kwarg_only]
    by_name = {a.name for a in arguments if a.kwarg_only}

    def layer(*args: Any, **named: Any) -> Any:
        if torch.compiler.is_compiling():
            return op(*args, **named)
        if may_be_differentiated():
            args = (*args, *(named.pop(name) for name in by_place[len(args) :]))
            call = Call.of(args, {name: value for name, value in named.items() if name in by_name})
            row = call.flat(args)
            if _is_differentiated(row):
                return kind.apply(call, *row)
        return run(*args, **named)

    def run(*args: Any, **named: Any) -> Any:
        """The kernel alone where nothing of PyTorch has to see the call, else the op."""
        alone = _is_unwatched() and not _is_transformed()
        alone = alone and _are_plain((*args, *named.values()))
        return (op._init_fn if alone else op)(*args, **named)

    layer.__name__ = layer.__qualname__ = _name(op)
    layer.__doc__ = op.__doc__
    return layer


def _is_differentiated(row: Sequence[Any]) -> bool:
    """Whether a derivative or a mapping is asked for; if none is, the op alone is faster."""
    return _is_transformed() or any(
        isinstance(value, Tensor) and value.requires_grad for value in row
    )


def may_be_differentiated() -> bool:
    """Whether a derivative of what is computed now could be asked for."""
    return torch.is_grad_enabled() or _is_transformed()


def is_kernel_alone(tensors: Sequence[Tensor]) -> bool:
    """Whether a kernel may be called past PyTorch: nothing of PyTorch has to see that it is called.

    Args:
        tensors: All that the kernel reads.
    """
    if torch.compiler.is_compiling() or not _is_unwatched() or not _are_plain(tensors):
        return False
    return not is_followed(tensors)


def is_followed(tensors: Sequence[Tensor]) -> bool:
    """Whether a derivative by one of some tensors, or a mapping, may be asked for now."""
    return may_be_differentiated() and _is_differentiated(tensors)


def _is_unwatched() -> bool:
    """Whether no compiler, tracer, profiler or mode follows the calls of ops."""
    return not (
        "torch._dynamo" in sys.modules
        or torch._C._len_torch_dispatch_stack()
        or torch._C._len_torch_function_stack()
        or torch._C._get_tracing_state() is not None
        or torch.autograd._profiler_enabled()  # type: ignore[attr-defined]
    )


def _are_plain(values: Iterable[Any]) -> bool:
    """Whether all tensors among arguments and their lists are what their memory says."""
    for value in values:
        if isinstance(value, Tensor):
            if type(value) not in _PLAIN or not value.is_cpu or value.is_neg():
                return False
        elif isinstance(value, list | tuple) and not _are_plain(value):
            return False
    return True


def _is_transformed() -> bool:
    # PyTorch has no public names for "inside of torch.func" and "inside of a dual level"
    return torch._C._functorch.maybe_current_level() is not None or forward_ad._current_level >= 0


def _name(op: Any) -> str:
    return str(op._qualname).replace("::", ".")


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
    kind = type(items[0])
    stacked = [s[0] if s[0] is None else torch.stack(s) for s in zip(*items, strict=True)]
    return kind(stacked), kind([0] * len(stacked))


def _item_by_item(one: Callable[..., Any], args: Sequence[Any]) -> Any:
    """What a derivative gives of every item, where PyTorch batches without a transform.

    ``is_grads_batched``, ``jacobian(vectorize=True)`` and gradcheck hand one tensor that stands for
    many and has no memory of its own, past the rules of ``torch.func.vmap``.
    """
    level = torch._C._vmapmode_increment_nesting() - 1  # PyTorch has no other word for the level
    torch._C._vmapmode_decrement_nesting()
    many = [isinstance(value, Tensor) and _stands_for_many(value) for value in args]
    dims = [0 if stands else None for stands in many]
    opened = [
        value if dim is None else torch._remove_batch_dim(value, level, 0, 0)
        for value, dim in zip(args, dims, strict=True)
    ]
    count = next(len(value) for value, dim in zip(opened, dims, strict=True) if dim == 0)
    stacked, _ = _one_by_one(one, count, dims, opened)
    if isinstance(stacked, Tensor):
        return torch._add_batch_dim(stacked, 0, level)
    return tuple(s if s is None else torch._add_batch_dim(s, 0, level) for s in stacked)


def _item(value: Any, dim: Any, k: int) -> Any:
    """Item k of an argument, or of every tensor of a list."""
    if dim is None:
        return value
    if isinstance(value, list):
        return [_item(v, d, k) for v, d in zip(value, dim, strict=True)]
    return value.select(dim, k).contiguous()
