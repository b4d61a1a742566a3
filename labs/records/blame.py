"""``python -m labs.records.blame``: what a first answer blames for the faults of damaged copies."""

from __future__ import annotations

import argparse
import io
import json
import secrets
import shlex
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.cli.diagnose_files import REPORT_FILE
from diffsim.cli.diagnose_steps import RECORD
from diffsim.cli.main import main as diffsim
from diffsim.core import interruptible, open_executor, run_kept
from labs.command import ended
from labs.records.damages import DAMAGES, damaged
from labs.records.rig import Folder

REFUSED, NOTHING, BLAMED, AS_SOUND = "refused", "nothing", "BLAMED", "as sound"
"""Outcomes beside that the record is named: no physics is asked; it is, and names nothing, or a
cause, or only what it says of the undamaged rig."""


def main(argv: Sequence[str] | None = None) -> int:
    """Damage, ask for first answers, and count.

    Args:
        argv: Arguments without the program's name; None takes the process's own.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    parser = argparse.ArgumentParser(prog="python -m labs.records.blame", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the run; resumes there")
    parser.add_argument("--seed", type=int, help="drawn afresh if not given")
    parser.add_argument("--num", type=int, default=8, help="damaged copies (default: 8)")
    parser.add_argument("--only", type=_part, default=(1, 1), metavar="I/N", help="every N-th")
    parser.add_argument("--executor", default=None, help="here (default) or processes:N")
    args = parser.parse_args(given)
    if args.seed is None:
        args.seed = secrets.randbelow(2**31)
        given += ["--seed", str(args.seed)]
    return ended(lambda: work(args), f"python -m labs.records.blame {shlex.join(given)}")


def work(args: argparse.Namespace) -> None:
    """Ask for the answers of a part of the cases, and print how they ended."""
    part, parts = args.only
    cases = {
        f"{args.seed}_{index:04d}": {"seed": args.seed, "index": index}
        for index in range(part - 1, args.num, parts)
    }
    with open_executor(args.executor) as executor:
        found = run_kept(solve, cases, args.out, executor, done=say)
    counts = Counter(row["outcome"] for row in found.values())
    ends = ", ".join(f"{count} {outcome}" for outcome, count in counts.most_common())
    cpu_s = sum(row["cpu_s"] for row in found.values())
    print(f"seed {args.seed}: of {len(found)} damaged copies {ends}; {cpu_s:.0f} CPU s")


def solve(case: Mapping[str, int]) -> dict[str, Any]:
    """How the first answer of one damaged copy ends.

    Args:
        case: Its ``seed`` and ``index``: neighbors have other damages.
    """
    seed, index = case["seed"], case["index"]
    rng, order = np.random.default_rng([seed, index]), np.random.default_rng(seed)
    kinds = [DAMAGES[k] for k in np.roll(order.permutation(len(DAMAGES)), -index)]
    drawn = ((kind, damaged(rng, kind)) for kind in kinds)
    # the next kind where no rig was drawn that can have the first
    damage, (sound, copy) = next((kind, pair) for kind, pair in drawn if pair is not None)
    started = time.process_time()
    row = answered(copy)
    if row["names"]:
        row["names_sound"] = answered(sound)["names"]
        is_new = set(row["names"]) - set(row["names_sound"])
        row["outcome"] = BLAMED if is_new else AS_SOUND
    rig = str(copy.study["name"])
    return {"damage": damage.name, "rig": rig, **row, "cpu_s": time.process_time() - started}


def answered(folder: Folder) -> dict[str, Any]:
    """What ``diffsim diagnose explain --quick`` says of a folder: outcome, names, first sentence.

    Names are causes, those of all rivals too, and numbers of the data sheet that are found wrong.
    """
    said, told = io.StringIO(), io.StringIO()
    with tempfile.TemporaryDirectory(prefix="blame_") as home:
        study, out = folder.write(Path(home) / "rig"), Path(home) / "out"
        with redirect_stdout(said), redirect_stderr(told):
            diffsim(["diagnose", "explain", str(study), "--quick", "--quiet", "--out", str(out)])
        if not (out / REPORT_FILE).is_file():
            lines = [line for line in said.getvalue().splitlines() if "error" in line]
            says = "; ".join((*lines[:2], *told.getvalue().splitlines()[:2]))
            return {"outcome": REFUSED, "names": [], "says": says.replace(home, "")}
        report = json.loads((out / REPORT_FILE).read_text(encoding="utf-8"))
    if report["verdict"] == RECORD:
        return {"outcome": RECORD, "names": [], "says": report["headline"]}
    numbers = [row["name"] for row in report["base"] if row["finding"]]
    names = {*report["named"], *(n for rival in report["rivals"] for n in rival), *numbers}
    says = f"{report['verdict']}: {report['headline']}"
    return {"outcome": BLAMED if names else NOTHING, "names": sorted(names), "says": says}


def say(name: str, row: Mapping[str, Any]) -> None:
    """One line for a case."""
    about = f"{row['damage']} on {row['rig']}: {row['outcome']}"
    print(f"{name} {about} ({', '.join(row['names'])}) {row['says'][:200]}", flush=True)


def _part(text: str) -> tuple[int, int]:
    """I/N: every N-th case from the I-th on."""
    first, _, parts = text.partition("/")
    try:
        part = int(first), int(parts)
    except ValueError:
        part = 0, 0
    if not 1 <= part[0] <= part[1]:
        raise argparse.ArgumentTypeError(f"expected I/N such as 3/16, 1 <= I <= N, got {text!r}")
    return part


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
