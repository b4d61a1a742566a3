"""``python -m labs.outside``: diagnose what other people's simulators made, and count.

The cases are those of ``labs/outside``. A case whose simulator is not installed is left out
and named. One line per case; ``--out`` keeps the answers, so that a second call goes on.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.cli.arguments import add_executor
from diffsim.core import interruptible, open_executor, run_each, run_kept
from diffsim.core.errors import DiffsimError
from diffsim.diagnose.diagnosis import diagnose
from diffsim.identify import fit
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.registry import setup_of
from labs.answers import answer_of, failure
from labs.outside.case import Case
from labs.outside.catalog import CASES

SEED = 1
SHOWN = 2  # rival sets in the table
VISIBLE = 8.0  # lambda from which a cause must be found


def judged(name: str, seed: int) -> dict[str, Any]:
    """Make one case, diagnose it, and hold the answer against what was hidden.

    Args:
        name: Name of the case.
        seed: Of its recordings.
    """
    case = CASES[name][1](seed)
    start = time.process_time()
    try:
        setup = setup_of(case.study)
        report = diagnose(
            setup.study or case.study,
            setup.model,
            setup.effects,
            seed=0,
            unknowns=setup.unknowns,
            settings=setup.settings,
        )
        answer = answer_of(report)
        cpu = time.process_time() - start
        strength = _strength(case, setup)
    except (DiffsimError, ValueError) as error:
        answer = failure(error)
        cpu, strength = time.process_time() - start, float("nan")
    return {
        "case": name,
        "seed": seed,
        "kind": case.kind,
        "hidden": dict(case.hidden),
        "lambda": strength,
        "cpu_s": cpu,
        **held_against(case, answer),
        **answer,
    }


def held_against(case: Case, answer: Mapping[str, Any]) -> dict[str, Any]:
    """Right, wrong name, false alarm; whether the size lies in its 90 % interval.

    Args:
        case: What was hidden.
        answer: What was said, as of ``answers.answer_of``.
    """
    verdict, truth = answer["verdict"], sorted(case.hidden)
    sets = [sorted(s) for s in (answer.get("named", []), *answer.get("rivals", [])) if s]
    known = [truth, *([name] for name in case.also)]
    if case.kind == "single":
        right = verdict in ("named", "ambiguous") and any(k in sets for k in known)
    else:
        right = verdict == {"null": "none", "outside": "unknown"}[case.kind]
    named = sorted(answer.get("named", []))
    return {
        "right": right,
        "wrong_name": verdict == "named" and named not in known,
        "false_alarm": case.kind == "null" and verdict not in ("none", "unrepeatable", "failed"),
        "inside": _inside(case, answer) if right else None,
    }


def _inside(case: Case, answer: Mapping[str, Any]) -> bool | None:
    """Whether every size that has a number lies in the interval that the page shows."""
    out: bool | None = None
    for name, true in case.hidden.items():
        shown = answer.get("intervals", {}).get(name, {}).get("size")
        if true is None or shown is None:
            continue
        _, low, high = shown
        out = bool(out in (None, True) and low <= true <= high)
    return out


def _strength(case: Case, setup: DiagnosisSetup) -> float:
    """lambda: what the refitted plain model leaves of the clean record, in noise sd."""
    left = fit(
        setup.model,
        case.clean.fit_runs,
        case.clean.channels,
        jacobian=setup.settings.jacobian,
    )
    return float(np.sqrt(left.chi2))


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The cases and their totals, in Markdown."""
    lines = [
        "| case | hidden | lambda | verdict | right | size in 90 % | CPU s |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        said = " + ".join(r.get("named", [])) or r.get("error", "")
        others = [" + ".join(s) for s in r.get("rivals", []) if s]
        rivals = "; ".join(others[:SHOWN])
        rivals += f"; {len(others) - SHOWN} more" if len(others) > SHOWN else ""
        verdict = f"{r['verdict']} {said}" + (f" (or {rivals})" if rivals else "")
        inside = {None: "", True: "yes", False: "no"}[r["inside"]]
        hidden = ", ".join(r["hidden"]) or {"null": "nothing"}.get(r["kind"], "beyond the library")
        lines.append(
            f"| {r['case']} | {hidden} | {r['lambda'] or float('nan'):.1f} | {verdict.strip()} | "
            f"{'yes' if r['right'] else '**no**'} | {inside} | {r['cpu_s']:.0f} |"
        )
    return "\n".join([*lines, "", *totals(rows)])


def totals(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Counts over all cases."""
    null = [r for r in rows if r["kind"] == "null"]
    visible = [r for r in rows if r["kind"] != "null" and not (r["lambda"] or np.nan) < VISIBLE]
    sized = [r for r in rows if r["inside"] is not None]
    counts = {
        f"right at lambda >= {VISIBLE:g}": (sum(r["right"] for r in visible), len(visible)),
        "false alarms": (sum(r["false_alarm"] for r in null), len(null)),
        "wrong names given alone": (sum(r["wrong_name"] for r in rows), len(rows)),
        "sizes in their 90 % interval": (sum(r["inside"] for r in sized), len(sized)),
    }
    return [f"- {what}: {hits} of {count}" for what, (hits, count) in counts.items()]


def main(argv: Sequence[str] | None = None) -> int:
    """Diagnose the cases that were asked for.

    Args:
        argv: Arguments without the program's name; None takes the process's own.

    Returns:
        Exit status: 0, or 2 if a case does not exist.
    """
    parser = argparse.ArgumentParser(prog="python -m labs.outside")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="cases, or beginnings of names")
    parser.add_argument("--seed", type=int, default=SEED, help="default: %(default)s")
    parser.add_argument("--out", type=Path, help="folder of the answers; goes on from there")
    add_executor(parser, "cases")
    parser.add_argument("--list", action="store_true", help="name the cases and stop")
    args = parser.parse_args(argv)
    names = [n for n in CASES if not args.only or n.startswith(tuple(args.only))]
    if not names:
        print(f"no such case; known: {', '.join(CASES)}", file=sys.stderr)
        return 2
    if args.list:
        print("\n".join(names))
        return 0
    items = {}
    for name in names:
        package = CASES[name][0]
        if importlib.util.find_spec(package) is None:
            print(f"{name}: left out, {package} is not installed", file=sys.stderr)
            continue
        items[f"{name}_{args.seed}"] = (name, args.seed)

    def say(row: Mapping[str, Any]) -> None:
        judgment = "right" if row["right"] else "WRONG"
        print(f"{row['case']}: {judgment}, {row['cpu_s']:.0f} s", flush=True)

    with open_executor(args.executor) as executor:
        if args.out is None:
            rows = run_each(_judged, list(items.values()), executor, done=lambda _, row: say(row))
        else:
            kept = run_kept(_judged, items, args.out, executor, done=lambda _, row: say(row))
            rows = list(kept.values())
    print("\n" + table(rows))
    return 0


def _judged(case: tuple[str, int]) -> dict[str, Any]:
    return judged(*case)


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
