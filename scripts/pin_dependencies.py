"""Write constraints.txt: install every extra into a fresh environment and pin what came.

    python3.11 scripts/pin_dependencies.py            # newest versions that pyproject.toml admits
    python3.11 scripts/pin_dependencies.py --keep torch numpy    # these stay at today's pins

A few minutes, most of it downloading. The environment is thrown away afterwards.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import venv
from datetime import date
from pathlib import Path

import tomllib

ROOT = Path(__file__).resolve().parent.parent
TARGET = ROOT / "constraints.txt"
OLDEST = "3.10"  # oldest Python of pyproject.toml; pins that exclude it get a marker
# Versions chosen by hand: torch is pinned to the release that every number in the docs was made on.
CHOSEN = {"torch": "2.13.0"}

# Runs inside the fresh environment: name, version (no local tag such as +cpu), Requires-Python.
_LIST = """
import importlib.metadata as m, json
print(json.dumps([(d.metadata["Name"], d.version.partition("+")[0],
                   d.metadata.get("Requires-Python") or "") for d in m.distributions()]))
"""

HEADER = """\
# Exact versions of everything that diffsim-robot's extras and its build install: the set that the
# tests run with. Users are not bound by it (pyproject.toml states ranges); scripts/setup is.
# Written by scripts/pin_dependencies.py on {date} with Python {python}; do not edit by hand.
# torch has no local tag: `torch=={torch}` admits the small CPU build (+cpu) where pip sees one.
# A pin with a marker has no release for older Pythons; there pip chooses within pyproject.toml.
"""


def requirements() -> list[str]:
    """What the project, its extras and its build ask for, without the project itself."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    asked = list(project["project"]["dependencies"]) + list(project["build-system"]["requires"])
    asked.append("uv")  # scripts/setup installs with it
    for extra in project["project"]["optional-dependencies"].values():
        asked += [r for r in extra if not r.startswith(project["project"]["name"])]
    return asked


def excludes(requires_python: str, version: str) -> bool:
    """Whether a Requires-Python such as '>=3.11,!=3.14.1' keeps ``version`` (3.10) out."""
    bounds = re.findall(r">=\s*(\d+)\.(\d+)", requires_python)
    return any((int(a), int(b)) > tuple(map(int, version.split("."))) for a, b in bounds)


def pin(name: str, version: str, requires_python: str) -> str:
    """One line of constraints.txt."""
    line = f"{name}=={version}"
    if not excludes(requires_python, OLDEST):
        return line
    major, minor = max(
        (int(a), int(b)) for a, b in re.findall(r">=\s*(\d+)\.(\d+)", requires_python)
    )
    return f'{line} ; python_version >= "{major}.{minor}"'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--keep", nargs="*", default=[], help="packages that keep today's pin")
    args = parser.parse_args()
    chosen = dict(CHOSEN)
    if args.keep:
        today = dict(re.findall(r"^([\w.-]+)==([^\s;]+)", TARGET.read_text(), re.MULTILINE))
        chosen |= {name: today[name] for name in args.keep}

    with tempfile.TemporaryDirectory(prefix="diffsim-pin-") as folder:
        venv.create(folder, with_pip=True)
        python = str(Path(folder) / "bin/python")
        limits = Path(folder) / "chosen.txt"
        limits.write_text("".join(f"{name}=={version}\n" for name, version in chosen.items()))
        pip = [python, "-m", "pip", "install", "--disable-pip-version-check", "-c", str(limits)]
        subprocess.run([*pip, "torch"], check=True)
        subprocess.run([*pip, *requirements()], check=True)
        listing = subprocess.run([python, "-c", _LIST], check=True, capture_output=True, text=True)

    found = {
        re.sub(r"[-_.]+", "-", name).lower(): (version, requires)
        for name, version, requires in json.loads(listing.stdout)
    }
    found.pop("pip", None)
    if cuda := [name for name in found if name.startswith(("nvidia-", "cuda-", "triton"))]:
        print(f"leaving out what only the CUDA build of torch installs: {', '.join(sorted(cuda))}")
    pins = [pin(n, v, r) for n, (v, r) in sorted(found.items()) if n not in cuda]
    header = HEADER.format(
        date=date.today(), python=sys.version.split()[0], torch=found["torch"][0]
    )
    TARGET.write_text(header + "\n".join(pins) + "\n")
    print(f"{len(pins)} pins written to {TARGET}")


if __name__ == "__main__":
    main()
