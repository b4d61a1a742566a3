"""Choose the compiled core for this processor: AVX-512, AVX2 or baseline.

``DIFFSIM_ISA=baseline|avx2|avx512`` forces one (tests run all that the processor has).
"""

import importlib
import os
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from types import ModuleType

from diffsim.core.forked import keep_forks_alive
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


keep_forks_alive()
core = load()
INSTRUCTION_SET: str = core.instruction_set
