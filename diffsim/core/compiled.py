"""Choose the compiled core for this processor: AVX-512, AVX2 or baseline.

``DIFFSIM_ISA=baseline|avx2|avx512`` forces one (tests run all that the processor has).
"""

import importlib
import os
import sys
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from types import ModuleType

from diffsim.core.processor import NEEDS, supported


def built() -> list[str]:
    """Instruction sets built for this Python (other Pythons' files may lie beside them)."""
    here = Path(__file__).parents[1]
    return [
        name
        for name in NEEDS
        if any((here / f"_core_{name}{suffix}").is_file() for suffix in EXTENSION_SUFFIXES)
    ]


def available() -> list[str]:
    """Instruction sets that are built and that this processor has, best first."""
    there = built()
    return [name for name in supported() if name in there]


def load() -> ModuleType:
    """Import the best core, or the one named by ``DIFFSIM_ISA``."""
    names = available()
    wanted = os.environ.get("DIFFSIM_ISA")
    if wanted:
        if wanted not in names:
            raise ImportError(
                f"DIFFSIM_ISA={wanted!r} is not available here; choose from {names} (built: "
                f"{built()}; DIFFSIM_BUILD_ISA=all pip install -e . builds all)"
            )
        names = [wanted]
    if not names:
        raise ImportError(
            "diffsim's compiled core is missing; build it with `pip install -e .` (needs a C++17 "
            "compiler) in the project's folder"
        )
    return importlib.import_module(f"diffsim._core_{names[0]}")


# Threads do not survive a fork, but PyTorch's pool in the child believes in them: its next parallel
# operation waits for ever. A child computes with one thread of PyTorch, as its ``DataLoader`` does.
# Kernels start their own threads at every call. Forking servers and ``spawn`` are not concerned.
def _use_one_thread() -> None:
    torch = sys.modules.get("torch")  # who has not imported it has no threads of it
    if torch is not None and torch.get_num_threads() > 1:
        torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):  # not on Windows, which has no forks
    os.register_at_fork(after_in_child=_use_one_thread)
core = load()
INSTRUCTION_SET: str = core.instruction_set
