"""Number of threads of linear algebra on small matrices."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import torch
from threadpoolctl import threadpool_limits

P = ParamSpec("P")
R = TypeVar("R")


def one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """A function that uses one thread of BLAS and of torch, as do threads that it starts.

    Arrays of a fit are too small to share: threads of BLAS that wait for each other took three
    quarters of the CPU time. Beside other work a second thread of torch made sums over 42 nodes a
    thousand times slower. Kernels and other threads are not limited.
    """

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        before = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            with threadpool_limits(limits=1, user_api="blas"):
                return function(*args, **kwargs)
        finally:
            torch.set_num_threads(before)

    return limited
