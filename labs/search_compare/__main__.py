"""``python -m labs.search_compare``: drawn cases under this version; two versions in one table."""

from __future__ import annotations

import argparse
import json
import re
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.cli.diagnose_inputs import inputs_of
from diffsim.core import interruptible, open_executor, run_kept
from diffsim.core.errors import DiffsimError
from diffsim.diagnose import diagnose
from diffsim.diagnose.say.report import Report
from diffsim.systems.registry import setup_of
from labs.command import ended
from labs.rates.case import solve as solve_rate
from labs.rates.plan import head
from labs.rates.score import HELD, OPEN, RIGHT
from labs.search_compare.cars import CARS
from labs.search_compare.drives import DRIVES
from labs.search_compare.rigs import RIGS as TOGETHER

PLACE = re.compile(r"(_\d+|_(of|at)_.*)$")
NUMBER = re.compile(r"_\d+$")
RIGS = {**TOGETHER, **DRIVES, **CARS}
NULLS = 4  # every fourth seed of a rig hides nothing
COLUMNS = ("right", "open", "wrong", "false names", "unseen error", "simulations", "CPU s")


def arguments() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m labs.search_compare",
        description="Diagnose drawn cases: rigs whose causes help only together, and cases of "
        "labs.rates. The same command goes on with a run. --table joins runs of two versions.",
    )
    parser.add_argument("--out", type=Path, help="folder of the run; resumes there")
    parser.add_argument("--seeds", type=int, default=4, help="of each rig (default: 4)")
    parser.add_argument("--rigs", default=",".join(RIGS), metavar="A,B", help="empty: none")
    parser.add_argument("--rates", default="", metavar="toy:9,ode:6", help="cases of labs.rates")
    parser.add_argument("--master", type=int, default=65, help="seed of these (default: 65)")
    parser.add_argument("--table", nargs=2, type=Path, metavar=("BEFORE", "AFTER"))
    parser.add_argument("--executor", default=None, help="as of labs.rates")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Diagnose or compare.

    Args:
        argv: Arguments without the program's name; None takes the process's own.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    args = arguments().parse_args(given)
    return ended(lambda: work(args), f"python -m labs.search_compare {shlex.join(given)}")


def work(args: argparse.Namespace) -> None:
    """Diagnose the cases that were asked for, or write the table of two runs."""
    if args.table:
        print(compared(*args.table))
        return
    if args.out is None:
        raise ValueError("--out FOLDER is missing: results of a run are kept there")
    with open_executor(args.executor) as executor:
        run_kept(solve, items(args), args.out, executor, done=say)


def items(args: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Cases by name."""
    out: dict[str, dict[str, Any]] = {
        f"{rig}_{seed}": {"rig": rig, "seed": seed}
        for seed in range(args.seeds)
        for rig in filter(None, args.rigs.split(","))
    }
    for word in filter(None, args.rates.split(",")):
        domain, _, count = word.partition(":")
        for index in range(int(count)):
            case = {"domain": domain, "index": index, "master": args.master, "effort": "quick"}
            out[f"{domain}_{index:04d}"] = case
    return out


def solve(item: Mapping[str, Any]) -> dict[str, Any]:
    """The row of a case."""
    if "domain" in item:
        row = solve_rate(item)
        return {
            "kind": item["domain"],
            "right": row["outcome"] == RIGHT,
            "open": row["outcome"] in (HELD, OPEN),
            "false": 0 if row["outcome"] in (RIGHT, HELD, OPEN) else len(row["named"]),
            "said": f"{row['outcome']}: {', '.join(row['named'])}",
            "error": None,
            **{k: row[k] for k in ("verdict", "cpu_s", "simulations")},
        }
    return _solve_rig(item["rig"], item["seed"])


def _solve_rig(name: str, seed: int) -> dict[str, Any]:
    is_null = seed % NULLS == NULLS - 1
    rig = RIGS[name]
    study = rig.record(seed, is_null)
    made = inputs_of(study, seed=0, budget="quick") if rig.with_laws else None
    setup = setup_of(study) if made is None else made.setup
    started, before = time.process_time(), setup.model.simulations.count
    row: dict[str, Any] = {"kind": f"{name}, null" if is_null else name}
    try:
        report = diagnose(
            study,
            setup.model,
            setup.effects,
            seed=0,
            unknowns=setup.unknowns,
            settings=setup.settings,
            laws=setup.laws if rig.with_laws else None,
        )
        row |= scored(report, frozenset() if is_null else rig.truth)
    except (DiffsimError, ValueError) as error:
        row |= {"right": False, "open": False, "false": 0, "said": str(error), "error": None}
        row["verdict"] = "failed"
    count = setup.model.simulations.count - before
    return {**row, "cpu_s": time.process_time() - started, "simulations": count}


def scored(report: Report, truth: frozenset[str]) -> dict[str, Any]:
    """Outcome of a rig, by the rows of the library whatever the place.

    Args:
        report: The answer.
        truth: Rows that act.
    """
    rows = {_row_of(name) for name in report.named}
    alike = (report.best_names, *report.rivals)
    sets = [{_row_of(n) for n in rival} for rival in alike]
    is_right = report.verdict in ("none", "data_sheet") if not truth else rows == truth
    is_among = truth in sets
    if report.verdict == "named":  # what is certain, and an exact twin of the rest
        is_open = rows < truth and is_among
    else:
        is_open = report.verdict in (HELD, OPEN) and (not truth or is_among or not rows)
    after = [(row.after / row.noise) ** 2 for row in report.errors]
    return {
        "right": is_right and report.verdict != "ambiguous",
        "open": is_open,
        "false": len(rows - truth) if report.verdict in ("named", "described") else 0,
        "said": f"{report.verdict}: {', '.join(report.best_names)}",
        "verdict": report.verdict,
        "error": float(np.sqrt(np.mean(after))) if after else None,
    }


def _row_of(name: str) -> str:
    """A cause without its place, a law without its number among those at one place."""
    is_law = name.startswith("law_of_")
    return (NUMBER if is_law else PLACE).sub("", name)


def say(name: str, row: Mapping[str, Any]) -> None:
    """One line for a case."""
    print(f"{name}: {row['said']}, {row['simulations']} sims, {row['cpu_s']:.0f} CPU s", flush=True)


def compared(before: Path, after: Path) -> str:
    """A table of the cases that both runs have, by kind: before / after in each cell."""
    old, new = (
        {p.stem: json.loads(p.read_text(encoding="utf-8"))["result"] for p in d.glob("*.json")}
        for d in (before, after)
    )
    shared = sorted(old.keys() & new.keys())
    kinds = dict.fromkeys(old[name]["kind"] for name in shared)
    lines = [f"Commit of the table: {head()[0][:10]}. Cells: before / after.", ""]
    lines += [f"| cases | {' | '.join(COLUMNS)} |", "|---" * (len(COLUMNS) + 1) + "|"]
    for kind in (*kinds, "all"):
        names = [name for name in shared if kind in ("all", old[name]["kind"])]
        cells = zip(*(_cells([rows[n] for n in names]) for rows in (old, new)), strict=True)
        lines.append(f"| {kind} ({len(names)}) | {' | '.join(f'{a} / {b}' for a, b in cells)} |")
    return "\n".join(lines)


def _cells(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    wrong = sum(not (row["right"] or row["open"]) for row in rows)
    errors = [row["error"] for row in rows if row["error"] is not None]
    return [
        str(sum(row["right"] for row in rows)),
        str(sum(row["open"] for row in rows)),
        str(wrong),
        str(sum(row["false"] for row in rows)),
        f"{np.median(errors):.2f} sd" if errors else "-",
        f"{sum(row['simulations'] for row in rows):,}",
        f"{sum(row['cpu_s'] for row in rows):.0f}",
    ]


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
