"""Processes that are forked after PyTorch has started threads.

Threads do not survive a fork, but PyTorch's pool in the child believes in them: its next parallel
operation waits for ever. A child therefore computes with one thread of PyTorch, as its
``DataLoader`` has it. Kernels of this library start their own threads at every call, and need
nothing. Forking servers and ``spawn`` are not concerned.
"""

from __future__ import annotations

import os
import sys


def _use_one_thread() -> None:
    torch = sys.modules.get("torch")  # who has not imported it has no threads of it
    if torch is not None and torch.get_num_threads() > 1:
        torch.set_num_threads(1)


def keep_forks_alive() -> None:
    """Let every child that is forked from now on use one thread of PyTorch."""
    if hasattr(os, "register_at_fork"):  # not on Windows, which has no forks
        os.register_at_fork(after_in_child=_use_one_thread)
