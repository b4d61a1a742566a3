"""Write docs/tutorials/outputs.json: what each code cell of the tutorials prints, for the site.

    python scripts/tutorial_outputs.py          # about two CPU minutes

The notebooks stay without outputs, so that a change of theirs is read as text.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

from diffsim.core.files import write_text_atomic

ROOT = Path(__file__).resolve().parent.parent
TUTORIALS = ROOT / "docs" / "tutorials"
OUTPUTS = TUTORIALS / "outputs.json"
MOST_LINES = 24  # of a cell's output


def printed(path: Path) -> list[str]:
    """What each code cell prints; a line with an exclamation mark is a command of the shell."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    names: dict[str, object] = {"__name__": "__main__"}
    found = []
    for source in ("".join(c["source"]) for c in cells if c["cell_type"] == "code"):
        if source.startswith("!diffsim "):
            command = [sys.executable, "-m", *shlex.split(source.removeprefix("!"))]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            found.append(shortened(done.stdout))
        else:
            told = io.StringIO()
            with contextlib.redirect_stdout(told):
                exec(compile(source, path.name, "exec"), names)
            found.append(shortened(told.getvalue()))
    return found


def shortened(text: str) -> str:
    """The first lines of an output."""
    lines = text.rstrip().splitlines()
    return "\n".join([*lines[:MOST_LINES], *["..."] * (len(lines) > MOST_LINES)])


def main() -> None:
    outputs = {}
    os.environ["PYTHONPATH"] = str(ROOT)  # for the commands, which run elsewhere
    for path in sorted(TUTORIALS.glob("*.ipynb")):
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            outputs[path.name] = printed(path)
            os.chdir(ROOT)
    write_text_atomic(OUTPUTS, json.dumps(outputs, indent=1, ensure_ascii=False) + "\n")
    print(f"wrote {OUTPUTS}")


if __name__ == "__main__":
    main()
