"""``diffsim info``: what runs here; imports no simulator, so it works where one does not."""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import platform
from pathlib import Path

from diffsim.core import paths
from diffsim.core.optional import extras, lacking
from diffsim.core.version import __version__

HELP = "versions, extras, processor, data folder"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``diffsim info``."""
    parser.add_argument(
        "--skill", action="store_true", help="print SKILL.md: how a language model works with this"
    )


def command(args: argparse.Namespace) -> None:
    """Print versions, the compiled core in use, and where data is looked for; or the skill."""
    if args.skill:
        print((Path(__file__).parents[1] / "SKILL.md").read_text("utf-8"), end="")
        return
    rows = [("diffsim", __version__), ("python", platform.python_version())]
    for name in ("torch", "numpy", "scipy"):
        try:
            rows.append((name, importlib.metadata.version(name)))
        except importlib.metadata.PackageNotFoundError:
            rows.append((name, "missing"))
    rows.append(("system", f"{platform.system()} {platform.machine()}"))
    try:
        from diffsim.core import compiled

        rows.append(("instruction set", compiled.core.instruction_set))
        rows.append(("available here", ", ".join(compiled.available())))
    except ImportError as err:
        rows.append(("compiled core", f"not loaded: {err}"))
    for name, wanted in extras().items():
        lacks = lacking(wanted)
        said = f"lacks {', '.join(lacks)}" if lacks else "installed"
        rows.append((f"extra {name}", said))
    rows.append(("processors", str(os.cpu_count())))
    rows.append(("package", str(Path(__file__).parents[1])))
    folder = paths.data_folder()
    rows.append(("data", str(folder) if folder else "not found (set DIFFSIM_DATA)"))
    rows += [("  looked for in", str(path)) for path in paths.data_candidates()]
    for name, value in rows:
        print(f"{name:<16} {value}")
