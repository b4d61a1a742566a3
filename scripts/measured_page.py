"""``python scripts/measured_page.py runs/diagnose/so101``: a page of docs/measured from an answer.

Question, what is open and notes are those of the study's ``metadata``; all else is the answer's.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from diffsim.systems import published

MARK = "<!-- Below this line: written by scripts/measured_page.py -->"
PAGES = Path(__file__).parents[1] / "docs/measured"
NAMED = ("certain", "likely")
LISTED = (*NAMED, "cannot be told from")  # statuses; sizes of what is named only


def page_of(report: Mapping[str, Any], study: Mapping[str, Any]) -> str:
    """The page.

    Args:
        report: Content of ``report.json``.
        study: Content of the published YAML.
    """
    name, told = study["name"], study.get("metadata", {})
    return "\n".join(
        [
            f"# {told.get('title', name)}\n\n{MARK}\n",
            f"**Question.** {told['question']} Source: {told['source']}.\n",
            f"```sh\ndiffsim diagnose explain {name} --quick\n```\n",
            f"**Answer.** `{report['verdict']}`. {report['headline']}\n",
            *(f"- {sentence}" for sentence in report["sentences"]),
            "\n| cause | said | size (90 %) |\n|---|---|---|",
            *_causes(report),
            "\n| unseen run | quantity | plain | extended | noise |\n|---|---|---|---|---|",
            *_errors(report),
            *(f"\n{note}" for note in told.get("found", ())),
            "",
        ]
    )


def _causes(report: Mapping[str, Any]) -> Iterator[str]:
    for row in report["causes"]:
        if row["status"] in LISTED:
            known = row["size"].values() if row["status"] in NAMED else ()
            sizes = [f"{s['low']:.3g} to {s['high']:.3g} {row['unit']}" for s in known]
            yield f"| {row['words']} | {row['status']} | {', '.join(sizes) or '-'} |"


def _errors(report: Mapping[str, Any]) -> Iterator[str]:
    for row in report["errors"]:
        values = " | ".join(f"{row[key]:.3g}" for key in ("before", "after", "noise"))
        yield f"| {row['run']} | {row['kind']} [{row['unit']}] | {values} |"


def main() -> None:
    """Write the page of an answer to docs/measured."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("answer", type=Path, help="folder of an answer")
    report = json.loads((parser.parse_args().answer / "report.json").read_text(encoding="utf-8"))
    source = Path(published.__file__).parent / f"{report['study']}.yaml"
    study = yaml.safe_load(source.read_text(encoding="utf-8"))
    path = PAGES / f"{report['study']}.md"
    path.write_text(page_of(report, study), encoding="utf-8")
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
