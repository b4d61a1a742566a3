"""Names of PyTorch that it does not promise to keep: what it has no public word for.

Nothing else in the package reads a private name of PyTorch. ``tests/core/test_imports.py`` says
with which version all of them were tried.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

TRIED = "2.13"
"""Version of PyTorch with which the names of this file were tried."""

_FUNC = torch._C._functorch

stands_for_many: Callable[[Tensor], bool] = _FUNC.is_legacy_batchedtensor
"""Whether a tensor is of the older kind of mapping, of ``is_grads_batched`` and gradcheck."""


@contextmanager
def on_constants() -> Iterator[None]:
    """A block, or as a decorator a function, that ``torch.func`` does not look into.

    There, even a plain tensor's memory is refused. For what is made of constants only, such as a
    mesh.
    """
    with torch._C._DisableFuncTorch():
        yield


def has_compiler() -> bool:
    """Whether PyTorch's compiler was imported; where nobody has, nobody compiles."""
    return "torch._dynamo" in sys.modules


def break_graph(message: str) -> None:
    """End the graph that is compiled here, and say why."""
    torch._dynamo.graph_break(msg=message)


def is_in_func() -> bool:
    """Whether a transform of ``torch.func`` is under way."""
    return _FUNC.maybe_current_level() is not None


def is_in_forward_mode() -> bool:
    """Whether a level of forward mode is open."""
    return forward_ad._current_level >= 0


def has_modes() -> bool:
    """Whether a mode sees the ops that are dispatched: fake tensors, tracers, checkpoints."""
    return torch._C._len_torch_dispatch_stack() > 0


def has_function_modes() -> bool:
    """Whether a mode sees the functions that are called."""
    return torch._C._len_torch_function_stack() > 0


def is_recorded() -> bool:
    """Whether ``make_fx`` records the ops that are called, for ``torch.func.linearize`` too."""
    tracer = sys.modules.get("torch.fx.experimental.proxy_tensor") if has_modes() else None
    return tracer is not None and tracer.get_proxy_mode() is not None


def is_watched(*, by_compilers: bool = True) -> bool:
    """Whether a tracer, profiler or mode follows the calls of ops, or a compiler may."""
    return (
        (by_compilers and has_compiler())
        or has_modes()
        or has_function_modes()
        or torch._C._get_tracing_state() is not None
        or torch.autograd._profiler_enabled()  # type: ignore[attr-defined]
    )


def has_hooks(module: torch.nn.Module) -> bool:
    """Whether something sees or changes what goes into a module, or comes out of it."""
    own = ("_forward_pre_hooks", "_forward_hooks", "_backward_pre_hooks", "_backward_hooks")
    of_all: bool = torch.nn.modules.module._has_any_global_hook()
    return of_all or any(getattr(module, name) for name in own)


def is_wrapped(value: Tensor) -> bool:
    """Whether a tensor is one of ``torch.func`` around another one."""
    return bool(_FUNC.is_functorch_wrapped_tensor(value))


def is_batched(value: Tensor) -> bool:
    """Whether the outermost wrapper of a tensor is a mapped axis."""
    return bool(_FUNC.is_batchedtensor(value))


def unwrapped(value: Tensor) -> Tensor:
    """A tensor without its outermost wrapper of ``torch.func``."""
    inner: Tensor = _FUNC.get_unwrapped(value)
    return inner


def opened(values: tuple[Any, ...]) -> tuple[list[Any], list[int | None], Callable[[Tensor], Any]]:
    """Values of the older kind of mapping, axis in front; where that is; and the way back."""
    level = torch._C._vmapmode_increment_nesting() - 1
    torch._C._vmapmode_decrement_nesting()
    dims = [0 if isinstance(v, Tensor) and stands_for_many(v) else None for v in values]
    inner = [
        value if dim is None else torch._remove_batch_dim(value, level, 0, 0)
        for value, dim in zip(values, dims, strict=True)
    ]
    return inner, dims, lambda value: torch._add_batch_dim(value, 0, level)


def call_past_compiler(op: Any, kernel: Callable[..., Any]) -> None:
    """Let a custom op call its kernel as it is where nobody compiles.

    PyTorch wraps the kernel so that its compiler leaves it alone, and imports the compiler for it:
    more than a second of every process, mostly of sympy.
    """
    kernels = getattr(op, "_backend_fns", {})  # without it all is as PyTorch has it
    wrapped = kernels.get(None)
    if wrapped is not None:

        def run(*args: Any, **named: Any) -> Any:
            return (wrapped if has_compiler() else kernel)(*args, **named)

        kernels[None] = run
