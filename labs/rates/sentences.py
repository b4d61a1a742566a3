"""First sentences of drawn cases beside what is hidden: is each true, and short enough?

A sentence is held to be true where the answer is: it says what is named, open, or not found. What
no rule can tell, as a clumsy phrase, is for a reader: the table has them all.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from diffsim.core.files import write_text_atomic
from diffsim.diagnose.say.headline import MAX_WORDS, first_of
from labs.rates.score import HELD, OPEN, RIGHT

COLUMNS = ("case", "hidden", "lambda", "outcome", "words", "first sentence", "amiss")
HEAD = f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|"


def amiss(row: Mapping[str, Any]) -> list[str]:
    """What is wrong with a case's first sentence, a word or two each.

    Args:
        row: Of a finished case.
    """
    said, out = first_of(row.get("headline", "")), []
    if not said:
        return ["none"]
    if row["outcome"] not in (RIGHT, HELD, OPEN):
        out.append(str(row["outcome"]))
    if len(said.split()) > MAX_WORDS:
        out.append("long")
    if re.search(r"\b[a-z]+_[a-z0-9_]+\b", said):
        out.append("code name")
    return out


def write_sentences(rows: Sequence[Mapping[str, Any]], path: Path) -> Path:
    """Write the table of first sentences.

    Args:
        rows: Finished cases.
        path: File to write.

    Returns:
        ``path``.
    """
    lines, num_good = [HEAD], 0
    for row in rows:
        said, why = first_of(row.get("headline", "")), amiss(row)
        num_good += not why
        cells = [
            f"{row['domain']}_{row['index']:04d}",
            row.get("hidden") or "nothing",
            f"{row.get('lambda', 0.0):.1f}",
            row["outcome"],
            str(len(said.split())),
            said.replace("|", "/"),
            ", ".join(why),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    lines.append(f"\n{num_good} of {len(rows)} are true and have at most {MAX_WORDS} words.")
    return write_text_atomic(path, "\n".join(lines) + "\n")
