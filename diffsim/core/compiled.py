"""Choose the compiled core for this processor: AVX-512, AVX2 or baseline.

``DIFFSIM_ISA=baseline|avx2|avx512`` forces one (tests run all that the processor has).
"""

import importlib
import os
import platform
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from types import ModuleType

# What each build needs of the processor, best first: the x86-64-v4 and -v3 levels (abm is lzcnt).
_V3 = {"avx", "avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "abm"}
_NEEDS = {
    "avx512": _V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"},
    "avx2": _V3,
    "baseline": set[str](),
}


def _cpu_flags() -> set[str]:
    """Processor flags as the kernel lists them; empty where it does not."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return set()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return set()
    flags = next((line for line in lines if line.startswith("flags")), "")
    return set(flags.partition(":")[2].split())


def built() -> list[str]:
    """Instruction sets built for this Python (other Pythons' files may lie beside them)."""
    here = Path(__file__).parents[1]
    return [
        name
        for name in _NEEDS
        if any((here / f"_core_{name}{suffix}").is_file() for suffix in EXTENSION_SUFFIXES)
    ]


def available() -> list[str]:
    """Instruction sets that are built and that this processor has, best first."""
    flags = _cpu_flags()
    return [name for name, needs in _NEEDS.items() if needs <= flags and name in built()]


def load() -> ModuleType:
    """Import the best core, or the one named by ``DIFFSIM_ISA``."""
    names = available()
    wanted = os.environ.get("DIFFSIM_ISA")
    if wanted:
        if wanted not in names:
            raise ImportError(f"DIFFSIM_ISA={wanted!r} is not available here; choose from {names}")
        names = [wanted]
    if not names:
        raise ImportError(
            "diffsim's compiled core is missing; build it with `pip install -e .` (needs a C++17 "
            "compiler) in the project's folder"
        )
    return importlib.import_module(f"diffsim._core_{names[0]}")


core = load()
INSTRUCTION_SET: str = core.instruction_set
