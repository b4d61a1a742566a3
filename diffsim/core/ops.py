"""Ops from a table: a row says what a kernel reads and gives, and its derivatives' kernels.

All that PyTorch asks of an op follows from its row: schema, shapes without values, checks, memory
of results, both modes of differentiation, mapped axes. Derivatives are rows, too, made here:
``NAME_vjp`` takes what derivatives read, then ``grad_OUTPUT``, then the options, and returns
``grad_INPUT``; ``NAME_jvp`` takes what they read, then ``d_INPUT``, then the options, and returns
``d_OUTPUT``. They refuse to be differentiated, unless the row says what the op is in PyTorch's own
operations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffsim.core.layer import NO_SECOND_ORDER, custom_op, make_layer


class Array(NamedTuple):
    """What holds for one tensor of an op."""

    # sizes; a name stands for that of the call, "name?" for it or 1, "..." for any axes
    shape: tuple[str | int, ...] = ()
    dtype: torch.dtype = torch.float64  # type of its numbers
    smooth: bool = True  # whether derivatives by it, or of it, are known
    # whether it may be empty instead: absent; a name: where that tensor is
    optional: bool | str = False
    zeroed: bool = False  # whether its memory is cleared before a kernel writes there
    like: str = ""  # name of the tensor whose shape it has; "": its own shape


def array(*shape: str | int, **properties: Any) -> Array:
    """An :class:`Array` by its sizes."""
    return Array(shape, **properties)


class Call(dict[str, Tensor]):
    """Tensors of one call by name: inputs, and outputs as memory to be filled, all contiguous.

    Attributes:
        options: Arguments that are no tensors.
        sizes: Sizes by the names that shapes use.
    """

    def __init__(self, tensors: Iterable[tuple[str, Tensor]], options: dict[str, Any]):
        super().__init__(tensors)
        self.options = options
        self.sizes: dict[str, Any] = {}

    def addresses(self, *names: str, prefix: str = "") -> dict[str, int]:
        """Where tensors lie, all or some, by name or by that of ``prefix`` + name."""
        return {name: self[prefix + name].data_ptr() for name in names or self}


class _Layout(NamedTuple):
    """What follows from the options and shapes of a call, and so holds for the next one like it."""

    key: Any
    sizes: dict[str, Any]
    outputs: list[tuple[Any, ...]]


Kernel = Callable[[Call], None]
Given = dict[str, Any]
Many = tuple[Tensor, ...]


class Op:
    """One row: a kernel as a function of tensors and options, by place or by name.

    Args:
        name: Of the op, ``diffsim::name``.
        inputs, outputs: What holds for each tensor, by name and in order.
        kernel: Fills the outputs of a call.
        options: Arguments after the inputs that are no tensors, as in a schema of PyTorch.
        sizes: Sizes that options and shapes of inputs tell, by name; all else is read from shapes,
            and numbers among the options are sizes, too.
        reads: Inputs and outputs that derivatives read; None: all inputs.
        adjoint: Kernel of the adjoint, of a call that has ``grad_NAME``, too.
        tangent: Kernel along one direction, of a call that has ``d_NAME``, too.
        in_torch: The smooth outputs by PyTorch's own operations, of what derivatives read and the
            options, by name: what derivatives of derivatives are made of.
        backward: In place of an adjoint: gradients by name of input, of what derivatives read and
            the options by name, and gradients of the outputs by name.
        forward: In place of a tangent: directions by name of output, of the same and directions of
            inputs by name; what does not move is missing.
        owner: What must live as long as a graph does, of the options.
        dropped: Smooth outputs that have no derivative after all, of the inputs by name.
        skips_still: Whether directions of what does not move are empty; else they are zeros.

    Attributes:
        op: The custom op of PyTorch.
        vjp, jvp: Rows of the derivatives; None where formulas stand for them.
    """

    def __init__(
        self,
        name: str,
        *,
        inputs: Mapping[str, Array],
        outputs: Mapping[str, Array],
        kernel: Kernel,
        options: str = "",
        sizes: Callable[[Call], Mapping[str, Any]] = lambda call: {},
        reads: Sequence[str] | None = None,
        adjoint: Kernel | None = None,
        tangent: Kernel | None = None,
        in_torch: Callable[[Given], tuple[Tensor, ...]] | None = None,
        backward: Callable[[Given, Given], Mapping[str, Tensor]] | None = None,
        forward: Callable[[Given, Given], Mapping[str, Tensor]] | None = None,
        owner: Callable[[Given], object] = lambda options: None,
        dropped: Callable[[Given], Sequence[str]] = lambda given: (),
        skips_still: bool = False,
    ):
        self.name, self.inputs, self.outputs = name, dict(inputs), dict(outputs)
        self.in_torch, self._kernel, self._sizes, self._owner = in_torch, kernel, sizes, owner
        self._option_types, self._dropped, self._skips_still = options, dropped, skips_still
        self._option_names = [option.split()[-1] for option in options.split(", ") if option]
        self._last = _Layout(None, {}, [])
        self.reads = list(self.inputs if reads is None else reads)
        self.arguments = [*self.inputs, *self._option_names]
        self._moving = [n for n, spec in self.inputs.items() if spec.smooth]
        self._followed = [n for n, spec in self.outputs.items() if spec.smooth]
        self.vjp = None if adjoint is None else self._adjoint_row(adjoint)
        self.jvp = None if tangent is None else self._tangent_row(tangent)
        self._backward = backward or self._gradients
        self._forward = forward or self._directions
        self.op = custom_op(f"diffsim::{name}", self._schema())(self._run_kernel)
        self.op.register_fake(self._fake)
        self._layer = make_layer(
            f"diffsim.{name}",
            self.op,
            self._run_kernel,
            self.arguments,
            setup=self._setup,
            backward=self._each_gradient,
            tangent=self._each_direction,
        )

    def __call__(self, *args: Any, **named: Any) -> Any:
        return self._layer(*args, **named)

    def _schema(self) -> str:
        tensors = [f"Tensor {name}" for name in self.inputs]
        results = ", ".join(["Tensor"] * len(self.outputs))
        given = ", ".join([*tensors, *filter(None, [self._option_types])])
        return f"({given}) -> " + (results if len(self.outputs) == 1 else f"({results})")

    # A call.

    def _bind(self, args: tuple[Any, ...], sizes: dict[str, Any] | None = None) -> Call:
        """Tensors, options and sizes of a call; ``sizes`` where they are known."""
        count = len(self.inputs)
        call = Call(
            zip(self.inputs, args[:count], strict=True),
            dict(zip(self._option_names, args[count:], strict=True)),
        )
        if sizes is not None:
            call.sizes = sizes
        else:
            call.sizes.update(call.options)
            call.sizes.update(self._sizes(call))
        return call

    def _run_kernel(self, *args: Any) -> Any:
        """The kernel, as PyTorch and its callers call it."""
        count = len(self.inputs)
        tensors, known = args[:count], self._last
        key = args[count:], [(value.shape, value.dtype) for value in tensors]
        if key == known.key and all([v.is_cpu and v.is_contiguous() for v in tensors]):
            return self._fill(self._bind(args, known.sizes), known.outputs, self._kernel)
        call = self._bind(args)
        self._check(call)
        shapes = self._shape_outputs(call)
        self._last = _Layout(key, call.sizes, shapes)
        return self._fill(call, shapes, self._kernel)

    def _check(self, call: Call) -> None:
        """Refuse tensors that the kernel cannot read; others become contiguous."""
        sizes = call.sizes
        for name, spec in self.inputs.items():
            value = call[name]
            # what belongs to an input that is not there is not there either
            owner = name if spec.optional is True else spec.optional or ""
            is_absent = bool(owner) and not call[owner].numel()
            if (
                not is_absent
                and _fits(value.shape, spec, sizes)
                and value.dtype is spec.dtype
                and value.is_cpu
                and value.is_contiguous()
            ):
                continue
            if is_absent:
                wanted = (0,) if value.numel() else value.shape
            else:
                wanted = _shape(spec, value.shape, call)
            if value.shape != wanted:
                raise ValueError(f"{name} must have shape {wanted}, got {tuple(value.shape)}")
            if value.dtype != spec.dtype or not value.is_cpu:
                raise TypeError(
                    f"{name} must be a {spec.dtype} CPU tensor, got {value.dtype} on {value.device}"
                )
            if not value.is_contiguous():
                call[name] = value.contiguous()

    def _fake(self, *args: Any) -> Any:
        """The results without their numbers."""
        call = self._bind(args)
        for name, spec in self.inputs.items():
            _shape(spec, call[name].shape, call)
        return self._fill(call, self._shape_outputs(call), lambda _: None)

    def _shape_outputs(self, call: Call) -> list[tuple[Any, ...]]:
        # not empty_like: what it is like may be an expanded view, kernels write densely
        return [
            tuple(call[spec.like].shape) if spec.like else resolve(spec, call.sizes)
            for spec in self.outputs.values()
        ]

    def _fill(self, call: Call, shapes: list[tuple[Any, ...]], kernel: Kernel) -> Any:
        first = next(iter(call.values()))
        for (name, spec), shape in zip(self.outputs.items(), shapes, strict=True):
            new = first.new_zeros if spec.zeroed else first.new_empty
            call[name] = new(shape, dtype=spec.dtype)
        kernel(call)
        results = tuple([call[name] for name in self.outputs])
        return results if len(results) > 1 else results[0]

    # Its derivatives.

    def _adjoint_row(self, kernel: Kernel) -> Op:
        known = self.inputs | self.outputs
        read = {name: known[name]._replace(smooth=name in self._moving) for name in self.reads}
        grads = {f"grad_{n}": known[n]._replace(zeroed=False) for n in self._followed}
        found = {
            f"grad_{n}": known[n]._replace(zeroed=True, like=n if n in read else "")
            for n in self._moving
        }
        return Op(
            f"{self.name}_vjp",
            inputs=read | grads,
            outputs=found,
            kernel=kernel,
            options=self._option_types,
            sizes=self._sizes,
            in_torch=None if self.in_torch is None else self._pull_back,
            owner=self._owner,
        )

    def _tangent_row(self, kernel: Kernel) -> Op:
        known = self.inputs | self.outputs
        read = {name: known[name]._replace(smooth=name in self._moving) for name in self.reads}
        still: dict[str, Any] = {"optional": True} if self._skips_still else {}
        moved = {f"d_{n}": known[n]._replace(like=n, **still) for n in self._moving}
        return Op(
            f"{self.name}_jvp",
            inputs=read | moved,
            outputs={f"d_{n}": known[n]._replace(zeroed=False) for n in self._followed},
            kernel=kernel,
            options=self._option_types,
            sizes=self._sizes,
            in_torch=None if self.in_torch is None else self._push_forward,
            owner=self._owner,
        )

    def _setup(self, ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        count = len(self.inputs)
        tensors = (*inputs[:count], *_many(output))
        given = dict(zip((*self.inputs, *self.outputs), tensors, strict=True))
        ctx.options = dict(zip(self._option_names, inputs[count:], strict=True))
        ctx.owner = self._owner(ctx.options)
        ctx.save_for_backward(*(given[name] for name in self.reads))
        dropped = {*self._dropped(given)} | self.outputs.keys() - {*self._followed}
        if dropped:
            ctx.mark_non_differentiable(*(given[name] for name in dropped))
        ctx.dropped = dropped

    def _take_given(self, ctx: Any) -> Given:
        return dict(zip(self.reads, ctx.saved_tensors, strict=True)) | ctx.options

    def _each_gradient(self, ctx: Any, *grads: Tensor) -> Any:
        named = dict(zip(self.outputs, grads, strict=True))
        found = self._backward(self._take_given(ctx), {n: named[n] for n in self._followed})
        return tuple(found.get(name) for name in self.arguments)

    def _each_direction(self, ctx: Any, *moved: Tensor | None) -> Any:
        named = dict(zip(self.arguments, moved, strict=True))
        moving = {n: named[n] for n in self._moving if named[n] is not None}
        found = self._forward(self._take_given(ctx), moving)
        out = tuple(None if n in ctx.dropped else found[n] for n in self.outputs)
        return out if len(out) > 1 else out[0]

    def _gradients(self, given: Given, grads: Given) -> Mapping[str, Tensor]:
        if self.vjp is not None:
            found = self.vjp(**given, **{f"grad_{name}": grad for name, grad in grads.items()})
        else:
            found = pull(*self._in_torch(given), tuple(grads.values()))
        return dict(zip(self._moving, _many(found), strict=True))

    def _directions(self, given: Given, moved: Given) -> Mapping[str, Tensor]:
        along = {n: moved[n] if n in moved else self._still(given[n]) for n in self._moving}
        if self.jvp is not None:
            found = self.jvp(**given, **{f"d_{name}": value for name, value in along.items()})
        else:
            found = push(*self._in_torch(given), tuple(along.values()))
        return dict(zip(self._followed, _many(found), strict=True))

    def _still(self, value: Tensor) -> Tensor:
        """The direction of what does not move."""
        return value.new_empty(0) if self._skips_still else torch.zeros_like(value)

    def _in_torch(self, given: Given) -> tuple[Callable[..., Many], list[Tensor]]:
        """The op in PyTorch's own operations as a function of what moves, and where that is."""
        formula = self.in_torch
        if formula is None:
            raise NotImplementedError(NO_SECOND_ORDER.format(name=f"diffsim.{self.name}"))
        return (
            lambda *at: formula(given | dict(zip(self._moving, at, strict=True))),
            [given[name] for name in self._moving],
        )

    def _pull_back(self, given: Given) -> Many:
        """The adjoint in PyTorch's own operations."""
        grads = tuple(given[f"grad_{name}"] for name in self._followed)
        return pull(*self._in_torch(given), grads)

    def _push_forward(self, given: Given) -> Many:
        """The tangent in PyTorch's own operations."""
        return push(*self._in_torch(given), tuple(given[f"d_{name}"] for name in self._moving))


def pull(function: Callable[..., Many], at: Sequence[Tensor], cotangents: Many) -> Many:
    """Gradients of a function's arguments."""
    return _linearize(function, *at)[1](cotangents)


def push(function: Callable[..., Many], at: Sequence[Tensor], directions: Many) -> Many:
    """Derivatives along directions: a gradient of a gradient, as forward mode cannot be nested."""
    out, back = _linearize(function, *at)
    zeros = tuple(torch.zeros_like(part) for part in out)
    return _linearize(lambda *cotangents: back(cotangents), *zeros)[1](directions)


def _linearize(function: Callable[..., Many], *at: Tensor) -> tuple[Many, Callable[[Many], Many]]:
    found: Any = torch.func.vjp(function, *at)
    return found


def _many(found: Any) -> Many:
    return (found,) if isinstance(found, Tensor) else tuple(found)


def _fits(shape: Sequence[Any], spec: Array, sizes: dict[Any, Any]) -> bool:
    """Whether sizes are plain and right; a quick word for most tensors, :func:`_shape` for all."""
    if spec.like or len(shape) != len(spec.shape):
        return False
    for size, name in zip(shape, spec.shape, strict=True):
        known = sizes.get(name, name)
        if size != known:
            if known is not name or not isinstance(name, str) or not name.isidentifier():
                return False
            sizes[name] = size
    return True


def _shape(spec: Array, shape: Sequence[Any], call: Call) -> tuple[Any, ...]:
    """The shape that a tensor must have; sizes that nobody has told are those that it has."""
    if spec.like:
        return tuple(call[spec.like].shape)
    if spec.shape[:1] == ("...",):
        call.sizes.setdefault("...", tuple(shape[: len(shape) - len(spec.shape) + 1]))
    elif len(spec.shape) == len(shape):
        for name, size in zip(spec.shape, shape, strict=True):
            if isinstance(name, str) and name[-1] != "?":
                call.sizes.setdefault(name, size)
    return resolve(spec, call.sizes, shape)


def resolve(spec: Array, sizes: Mapping[Any, Any], shape: Sequence[Any] = ()) -> tuple[Any, ...]:
    """Shape of an array; "name?" is 1 where ``shape`` is, and what nobody knows its name."""
    if spec.shape[:1] != ("...",):
        plain = tuple([sizes.get(name, name) for name in spec.shape])
        if not any([isinstance(size, str) for size in plain]):
            return plain
    found: list[Any] = []
    for k, name in enumerate(spec.shape):
        if not isinstance(name, str):
            found.append(name)
        elif name == "...":
            found.extend(sizes[name])
        elif name[-1] == "?" and k < len(shape) and shape[k] == 1:
            found.append(1)
        else:
            found.append(sizes.get(name.rstrip("?"), name))
    return tuple(found)
