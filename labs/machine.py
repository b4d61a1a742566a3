"""Where and with what a benchmark ran: goes into every result."""

from __future__ import annotations

import datetime
import hashlib
import os
import platform
import re
import subprocess
from pathlib import Path
from typing import Any

import numpy
import torch

import diffsim
from diffsim.core.compiled import INSTRUCTION_SET, core
from diffsim.core.executors import num_processors

ROOT = Path(__file__).resolve().parents[1]


def machine() -> dict[str, Any]:
    """Processor, software, date and commit."""
    return {
        "cpu": _cpu_model(),
        "cores": num_processors(),
        "caches": _caches(),
        "memory_available_GiB": round(available_memory() / 2**30, 1),
        "instruction_set": INSTRUCTION_SET,
        "compiler": _compiler(),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": numpy.__version__,
        "date": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        "commit": _commit(),
        # Above about 0.1 at the start, others were using the machine: wall times are too long.
        "load_average_at_start": os.getloadavg()[0],
    }


def code_fingerprint(*rooms: str) -> str:
    """Digest of the loaded binary, of Python files and their data: what results depend on.

    Args:
        rooms: Folders of the package besides ``core`` and ``linalg``, such as "soft".
    """
    digest = hashlib.sha256(Path(core.__file__).read_bytes())
    package = Path(diffsim.__file__).parent
    inside = [f"{room}/**/*.{ending}" for room in rooms for ending in ("py", "yaml")]
    for pattern in (*inside, "core/*.py", "linalg/*.py"):
        for path in sorted(package.glob(pattern)):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def available_memory() -> int:
    """Memory that can be had without swapping [byte]."""
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    return 4 << 30


def _cpu_model() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor() or platform.machine()
    found = re.search(r"^model name\s*:\s*(.*)$", text, re.MULTILINE)
    family = re.search(r"^cpu family\s*:\s*(.*)$", text, re.MULTILINE)
    name = found[1] if found else platform.machine()
    return f"{name} (family {family[1]})" if family else name


def _caches() -> str:
    levels = []
    for index in sorted(Path("/sys/devices/system/cpu/cpu0/cache").glob("index*")):
        kind = (index / "type").read_text().strip()
        if kind != "Instruction":
            level, size = ((index / name).read_text().strip() for name in ("level", "size"))
            levels.append(f"L{level} {size}")
    return ", ".join(levels) or "unknown"


def _compiler() -> str:
    """As the compiler signed the binary; "unknown" where it did not."""
    found = re.findall(
        rb"(?:GCC: \([^)]*\)|clang version) [\d.]+", Path(core.__file__).read_bytes()
    )
    return ", ".join(sorted({text.decode() for text in found})) or "unknown"


def _commit() -> str:
    def git(*args: str) -> str:
        done = subprocess.run(["git", *args], cwd=ROOT, capture_output=True, text=True)
        return done.stdout.strip() if done.returncode == 0 else ""

    commit = git("rev-parse", "--short=12", "HEAD")
    if not commit:
        return "unknown"
    return commit + (" with local changes" if git("status", "--porcelain", "-uno") else "")
