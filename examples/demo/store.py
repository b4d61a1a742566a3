"""``python -m examples.demo.store RUN RECORDINGS``: store the dear answers of a finished demo."""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from diffsim.core.files import read_kept, write_text_atomic
from examples.data.beam import load_beam_study
from examples.demo.plan import FULL
from examples.demo.stored import FOLDER, STAGES, asked

DIGITS = 5  # significant ones; a step is solved to 1e-5


def main(arguments: Sequence[str] | None = None) -> None:
    """Store the answers of a run of ``diffsim demo --all``."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("folder", type=Path, help="--out of that run")
    parser.add_argument("data", type=Path, help="folder of the beam's recordings")
    given = parser.parse_args(arguments)
    results = {}
    for name in STAGES:
        kept = read_kept(given.folder / "stages" / f"{name}.json")
        if kept is None:
            parser.error(f"{given.folder} has no finished stage {name}")
        if "skipped" not in kept["result"]:
            results[name] = kept["result"]
    commit = subprocess.run(
        ["git", "rev-parse", "--short=10", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()
    question = asked(load_beam_study(given.data), FULL)
    content = {"commit": commit, "of": question, "results": _rounded(results)}
    path = FOLDER / f"{given.data.resolve().name}.json"
    write_text_atomic(path, json.dumps(content, separators=(",", ":")) + "\n")
    print(f"wrote {path}")


def _rounded(value: Any) -> Any:
    """The same content with numbers of ``DIGITS`` digits."""
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    if isinstance(value, dict):
        return {key: _rounded(part) for key, part in value.items()}
    return [_rounded(part) for part in value] if isinstance(value, list) else value


if __name__ == "__main__":
    with interruptible():
        main()
