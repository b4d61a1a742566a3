"""Does a stranger's first hour with an installed diffsim pass without a stumble?

    python first_hour.py CLONE        # in a fresh environment with the wheel, an empty folder
    python first_hour.py CLONE --only recipes.md commands

Runs what the pages tell a reader to run, literally: each page's blocks of Python, YAML and shell
one after the other in a folder of their own, then the commands that need no page. The pages are
read from CLONE; the package is the installed one. The environment has the extras that the pages
name: ``pip install 'WHEEL[rl,robots,viz,formats]'``. It ends with a line ``first hour passed``,
or with status 1 and the output of what failed.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import diffsim

PAGES = (
    "docs/recipes.md",
    "docs/tutorials/1_own_shape.ipynb",
    "docs/tutorials/2_own_quadrotor.ipynb",
    "docs/tutorials/3_own_recording.ipynb",
    "examples/colab.ipynb",
)
# what README and pages offer without a page of blocks of its own
COMMANDS = (
    "diffsim --version",
    "diffsim info",
    "diffsim examples list",
    "diffsim examples run sliding_block",
    "diffsim play",
    "diffsim play CopterHover --no-film",
    "diffsim fabricate pentacopter --out kit",
    "diffsim fly pentacopter --seconds 1 --out flight",
    "diffsim convert flight/flight.csv",
    "diffsim diagnose init flight --out flight/study.yaml",
    "diffsim diagnose schema",
)
WRITTEN = re.compile(r"```(python|yaml|sh)\n(.*?)```", re.S)
INSTALLS = "!pip install"  # the environment stands already
UPLOADED = "diffsim_robot-installed.whl"  # the wheel that a notebook asks for: installed, too


def blocks(page: Path) -> list[tuple[str, str]]:
    """Kind ('python', 'yaml', 'sh') and text of what a page has a reader run, in its order."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".md":
        return WRITTEN.findall(text)
    cells = [c for c in json.loads(text)["cells"] if c["cell_type"] == "code"]
    return [block for cell in cells for block in _parts("".join(cell["source"]))]


def _parts(source: str) -> list[tuple[str, str]]:
    """A notebook's cell in blocks: lines with an exclamation mark are the shell's."""
    found: list[tuple[str, str]] = []
    for line in source.splitlines(keepends=True):
        if line.startswith(INSTALLS):
            continue
        kind = "sh" if line.startswith("!") else "python"
        if found and found[-1][0] == kind:
            found[-1] = (kind, found[-1][1] + line.removeprefix("!"))
        else:
            found.append((kind, line.removeprefix("!")))
    return found


def script(page: Path) -> str:
    """The page as one script: Python as it stands, YAML written to the file that it names."""
    lines = ["import subprocess as _shell", "from pathlib import Path as _Path"]
    for kind, text in blocks(page):
        if kind == "python":
            lines.append(text)
        elif kind == "yaml":
            name = text.split("\n")[0].removeprefix("# ")
            lines.append(f"_Path({name!r}).write_text({text!r}, encoding='utf-8')")
        else:
            lines.append(f"_shell.run({'set -e' + chr(10) + text!r}, shell=True, check=True)")
    return "\n".join(lines) + "\n"


def passes(name: str, command: list[str], folder: Path) -> bool:
    """Run a command in a folder; say how long it took, and what it said where it failed."""
    folder.mkdir(parents=True, exist_ok=True)
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    began = time.perf_counter()
    done = subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, "PATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    took = time.perf_counter() - began
    (folder / "said.txt").write_text(done.stdout, encoding="utf-8")
    print(f"  {name}: status {done.returncode}, {took:.0f} s", flush=True)
    if done.returncode != 0:
        print(done.stdout[-3000:], flush=True)
    return done.returncode == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("clone", type=Path, help="the clone whose pages are followed")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="pages by name, or 'commands'")
    options = parser.parse_args()
    where = Path(diffsim.__file__).parent
    print(f"diffsim {diffsim.__version__}, Python {sys.version.split()[0]}, {where}")
    if (where.parent / "pyproject.toml").exists():
        raise SystemExit(f"this is a checkout, not what a wheel installed: {where}")
    here, passed = Path.cwd() / "first_hour", []
    for page in (options.clone.resolve() / name for name in PAGES):
        if options.only is None or page.name in options.only:
            folder = here / page.stem
            folder.mkdir(parents=True)
            (folder / UPLOADED).touch()
            (folder / "page.py").write_text(script(page), encoding="utf-8")
            passed.append(passes(page.name, [sys.executable, "page.py"], folder))
    if options.only is None or "commands" in options.only:
        for line in COMMANDS:
            passed.append(passes(line, line.split(), here / "commands"))
    print("first hour passed" if all(passed) else f"{passed.count(False)} stumbled")
    return 0 if passed and all(passed) else 1


if __name__ == "__main__":
    sys.exit(main())
