"""Instruction sets: what each needs of a processor, and what this one has (standard library only).

The build reads this file too (``setup.py``), so nothing of diffsim may be imported here.
"""

import platform
from pathlib import Path

# What each build needs of the processor, best first: the x86-64-v4 and -v3 levels (abm is lzcnt).
_V3 = {"avx", "avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "abm"}
NEEDS = {
    "avx512": _V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"},
    "avx2": _V3,
    "baseline": set[str](),
}


def cpu_flags() -> set[str]:
    """Processor flags as the kernel lists them.

    Returns:
        Names such as ``avx2``; empty where the system does not list them.
    """
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return set()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return set()
    flags = next((line for line in lines if line.startswith("flags")), "")
    return set(flags.partition(":")[2].split())


def supported() -> list[str]:
    """Instruction sets that this processor has.

    Returns:
        Names, best first; the last is always ``baseline``.
    """
    flags = cpu_flags()
    return [name for name, needs in NEEDS.items() if needs <= flags]
