"""``python -m benchmarks.first_sentences FOLDER``: the table of first sentences of saved answers.

FOLDER holds NAME.json of published sets, as ``benchmarks.diagnose_published --json FOLDER`` keeps
them. What is new there replaces the row of its set in ``studies/records/first_sentences.json``; the
page ``first_sentences.md`` beside it is written from that file alone. Without FOLDER the page is
written anew. Each sentence is held against its own answer: at most 25 words, no code name, and the
error before and after as the table of errors has them.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from diffsim.core.files import write_json_atomic, write_text_atomic
from diffsim.diagnose.judge.records import ErrorRow, pooled_by_kind
from diffsim.diagnose.say.headline import MAX_WORDS, first_of

RECORD = Path(__file__).parents[1] / "studies/records/first_sentences.json"
COLUMNS = ("data set", "verdict", "words", "first sentence", "amiss")
HEAD = f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|"
ERROR = re.compile(r"(?:unseen error|unseen runs)(?: rises from)? ([\d.e-]+) to ([\d.e-]+)")
BY_SCRIPT = ("nano_drone", "servo_go1", "servo_sts3215", "servo_sts3250", "wind_flights")
"""Sets whose recordings come by a script of their own: no answer of theirs is kept."""
PLACES = 0.006  # relative: three digits, of a root of squares of rounded numbers


def row_of(answer: Mapping[str, Any]) -> dict[str, Any]:
    """What the record keeps of an answer.

    Args:
        answer: Content of ``report.json`` or ``faults.json``.

    Returns:
        Verdict, first sentence, and errors on unseen runs: ``kind``, ``unit``, root mean squares
        ``before`` and ``after`` of each quantity.
    """
    pooled = pooled_by_kind([ErrorRow(**e) for e in answer.get("errors", ())])
    errors = [{k: getattr(row, k) for k in ("kind", "unit", "before", "after")} for row in pooled]
    said = first_of(answer["headline"])
    return {"verdict": answer.get("verdict", "faults"), "said": said, "errors": errors}


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


def page_of(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """The page, Markdown.

    Args:
        rows: By name of the data set.
    """
    assert __doc__ is not None
    lines = [HEAD]
    for name in sorted(rows):
        row = rows[name]
        cells = [name, row["verdict"], str(len(row["said"].split())), row["said"]]
        lines.append(f"| {' | '.join([*cells, ', '.join(amiss(row)) or '–'])} |")
    good = sum(not amiss(row) for row in rows.values())
    return "\n".join(
        [
            "# First sentences of the published sets\n",
            "First answers (`diffsim diagnose explain NAME --quick`), by\n",
            "```sh\npython -m benchmarks.diagnose_published --quick --json FOLDER",
            "python -m benchmarks.first_sentences FOLDER\n```\n",
            f"{good} of {len(rows)} have at most {MAX_WORDS} words, no code name, and the errors "
            f"of their answer. Without data here: {', '.join(BY_SCRIPT)}.\n",
            *lines,
            "",
        ]
    )


def main() -> None:
    """Renew the record from saved answers, and the page from the record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", help="folder of NAME.json")
    args = parser.parse_args()
    rows = json.loads(RECORD.read_text(encoding="utf-8")) if RECORD.exists() else {}
    for path in sorted(args.folder.glob("*.json")) if args.folder else ():
        rows[path.stem] = row_of(json.loads(path.read_text(encoding="utf-8")))
    write_json_atomic(RECORD, rows)
    page = write_text_atomic(RECORD.with_suffix(".md"), page_of(rows))
    print(f"wrote {page}")


if __name__ == "__main__":
    main()
