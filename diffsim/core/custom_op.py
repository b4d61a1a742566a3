"""Torch custom ops, and what stays outside of graphs, without importing torch's compiler."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import torch


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
