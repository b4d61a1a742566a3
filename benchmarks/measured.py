"""``python -m benchmarks.measured``: answers of the published sets, their record and its tables.

    python -m benchmarks.measured                    # tables from the record, nothing is computed
    python -m benchmarks.measured --all              # first answers of all sets with data here
    python -m benchmarks.measured --ask emps,starfish --full

What it asks goes to ``studies/records/measured.json`` set by set, with date, machine, commit and
CPU seconds: an interrupted call goes on with what is missing. A set whose row is of this very code
is not asked again. The tables are written from the record alone: docs/measured/README.md, and first
sentences, each held against its own answer: at most 25 words, no code name, and the error before
and after as the table of errors has them.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from benchmarks.diagnose_published import NAMES, Asked, asked
from diffsim.core import interruptible
from diffsim.core.errors import DiffsimError
from diffsim.core.files import code_digest, write_json_atomic, write_text_atomic
from diffsim.diagnose.judge.records import ErrorRow, pooled_by_kind
from diffsim.diagnose.say.headline import MAX_WORDS, first_of
from labs.machine import machine

ROOT = Path(__file__).parents[1]
RECORD = ROOT / "studies/records/measured.json"
SENTENCES = ROOT / "studies/records/first_sentences.md"
PAGE = ROOT / "docs/measured/README.md"
BEGIN, END = "<!-- answers: written by python -m benchmarks.measured -->", "<!-- end of answers -->"
ERROR = re.compile(r"(?:unseen error|unseen runs)(?: rises from)? ([\d.e-]+) to ([\d.e-]+)")
BY_SCRIPT = ("nano_drone", "servo_go1", "servo_sts3215", "servo_sts3250", "wind_flights")
"""Sets whose recordings come by a script of their own: no sentence of theirs is kept."""
PAGES = {
    "pneumatic_arm_p25": "pneumatic_arm",
    "rotor_drive": "rotor_bench",
    "servo_go1": "servo_bench",
    "servo_sts3215": "servo_bench",
    "servo_sts3250": "servo_bench",
}
"""Where a set's page has another name."""
PLACES = 0.006  # relative: three digits, of a root of squares of rounded numbers
GOAL_S = 60.0  # CPU seconds of a first answer
Rows = dict[str, dict[str, dict[str, Any]]]
FIRST, FULL = "first", "full"


def row_of(found: Asked) -> dict[str, Any]:
    """What the record keeps of an answer.

    Args:
        found: The answer.

    Returns:
        Verdict, first sentence, certain causes, CPU seconds, millions of weighted steps, and errors
        on unseen runs: ``kind``, ``unit``, root mean squares ``before`` and ``after`` of each
        quantity.
    """
    pooled = pooled_by_kind([ErrorRow(**e) for e in found.content.get("errors", ())])
    errors = [{k: getattr(row, k) for k in ("kind", "unit", "before", "after")} for row in pooled]
    return {
        "verdict": found.verdict,
        "said": first_of(found.content["headline"]),
        "errors": errors,
        "certain": list(found.certain),
        "cpu_s": round(found.cpu_s),
        "steps": round(found.steps, 1),
    }


def amiss(row: Mapping[str, Any]) -> list[str]:
    """What is wrong with a first sentence, some words each.

    Args:
        row: As ``row_of`` makes it.
    """
    said, out = row["said"], []
    if len(said.split()) > MAX_WORDS:
        out.append("long")
    if re.search(r"\b[a-z]+_[a-z0-9_]+\b", said):
        out.append("code name")
    if row["errors"] and not _has_error(said, row["errors"]):
        out.append("another error")
    return out


def _has_error(said: str, errors: Sequence[Mapping[str, Any]]) -> bool:
    """Whether a sentence quotes the errors of one quantity, in any power of ten, or none."""
    quoted = ERROR.search(said)
    if quoted is None:
        return "error" not in said
    before, after = (float(value) for value in quoted.groups())
    fell = [e["after"] / e["before"] for e in errors if e["before"] > 0.0]
    return any(abs(after / before / ratio - 1.0) < 2.0 * PLACES for ratio in fell)


def sentences_of(rows: Rows) -> str:
    """The page of first sentences, Markdown.

    Args:
        rows: The record.
    """
    said = {n: row[FIRST] for n, row in sorted(rows.items()) if row.get(FIRST, {}).get("said")}
    good = sum(not amiss(row) for row in said.values())
    lines = [
        "# First sentences of the published sets\n",
        "First answers (`diffsim diagnose explain NAME --quick`), by\n",
        "```sh\npython -m benchmarks.measured --all\n```\n",
        f"{good} of {len(said)} have at most {MAX_WORDS} words, no code name, and the errors of "
        f"their answer. Without data here: {', '.join(BY_SCRIPT)}.\n",
        "| data set | verdict | words | first sentence | amiss |",
        "|---|---|---|---|---|",
    ]
    for name, row in said.items():
        cells = [name, row["verdict"], str(len(row["said"].split())), row["said"]]
        lines.append(f"| {' | '.join([*cells, ', '.join(amiss(row)) or '–'])} |")
    return "\n".join([*lines, ""])


def table_of(rows: Rows) -> str:
    """The table of verdicts and CPU seconds, Markdown.

    Args:
        rows: The record.
    """
    lines = [
        "| data set | full: verdict | certain | CPU s | first: verdict | CPU s | by commit |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, row in sorted(rows.items()):
        first, full = row.get(FIRST, {}), row.get(FULL, {})
        certain = ", ".join(full.get("certain", ())) or ("–" if full else "")
        if full.get("verdict") == "faults":
            certain = "per group"
        seconds = f"{first['cpu_s']}{'~' * first.get('busy', False)}" if first else ""
        if first and first["cpu_s"] > GOAL_S:
            seconds = f"**{seconds}**"
        cells = [
            f"[{name}]({PAGES.get(name, name)}.md)",
            full.get("verdict", ""),
            certain,
            str(full.get("cpu_s", "")),
            first.get("verdict", ""),
            seconds,
            first.get("commit", ""),
        ]
        lines.append("".join(f"| {cell} " if cell else "| " for cell in cells) + "|")
    return "\n".join(lines)


def with_table(page: str, rows: Rows) -> str:
    """A page with the table of a record between its marks.

    Args:
        page: Markdown with ``BEGIN`` and ``END``.
        rows: The record.
    """
    before, rest = page.split(BEGIN)
    return f"{before}{BEGIN}\n{table_of(rows)}\n{END}{rest.split(END)[1]}"


def _commit() -> str:
    """The commit that is measured; with a plus where the working tree differs from it."""
    asked_git = subprocess.run(
        ["git", "describe", "--always", "--abbrev=8", "--dirty=+", "--exclude=*"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return asked_git.stdout.strip()


def _ask(names: Sequence[str], rows: Rows, which: str, *, again: bool) -> None:
    """Ask what is missing in a record, which is written after each answer."""
    code, commit = code_digest(), _commit()
    known = {n: rows.get(n, {}).get(which, {}) for n in names}
    names = [n for n in names if again or known[n].get("code") != code]
    minutes = sum(float(known[n].get("cpu_s", 0.0)) for n in names) / 60.0
    print(f"{len(names)} {which} answers, some {minutes:.0f} CPU minutes by the record")
    for name in names:
        try:
            found = asked(name, quick=which == FIRST)
        except (DiffsimError, ValueError) as error:
            print(f"{name}: {error}", file=sys.stderr)
            continue
        today = datetime.now(UTC).date().isoformat()
        busy = os.getloadavg()[0] > (os.cpu_count() or 1)
        row = row_of(found) | {"date": today, "commit": commit, "code": code, "busy": busy}
        row["machine"] = machine()["cpu"]
        if name in BY_SCRIPT:
            row |= {"said": None, "errors": []}
        rows.setdefault(name, {})[which] = row
        write_json_atomic(RECORD, rows)
        print(f"{name}: {found.verdict}, {found.cpu_s:.0f} CPU s. {found.said}", flush=True)


def main() -> None:
    """Renew the record where that is asked, and the tables from the record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ask", default="", help="names of sets, comma between them")
    parser.add_argument("--all", action="store_true", help="all sets")
    parser.add_argument("--full", action="store_true", help="full answers in place of first ones")
    parser.add_argument("--again", action="store_true", help="ask those of this code, too")
    args = parser.parse_args()
    rows: Rows = json.loads(RECORD.read_text(encoding="utf-8"))
    names = NAMES if args.all else [n for n in args.ask.split(",") if n]
    if names:
        _ask(names, rows, FULL if args.full else FIRST, again=args.again)
    write_text_atomic(SENTENCES, sentences_of(rows))
    page = PAGE.read_text(encoding="utf-8")
    print(f"wrote {SENTENCES} and {write_text_atomic(PAGE, with_table(page, rows))}")


if __name__ == "__main__":
    with interruptible():
        main()
