"""First sentences of recorded answers: short, and true to what the record holds.

``python -m tests.diagnose.say.test_answers FOLDER`` renews the records: FOLDER is what
``python -m benchmarks.diagnose_published --quick --json FOLDER`` has kept.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from diffsim.diagnose.checks.gates import GateResult
from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.preconditions import MAY_BE_ZERO
from diffsim.diagnose.judge.records import CauseRow, ErrorRow, Interval
from diffsim.diagnose.say.headline import first_of, headline
from diffsim.diagnose.say.wording import Answer, BeforeTest

HERE = Path(__file__).parent / "answers"
KEPT = ("verdict", "named", "rivals", "gain", "before_test", "errors", "unknown_share")
TOLD = ("certain", "likely")
CODE = re.compile(r"\w_\w|@|\bnats\b|gradient check|and \d+ more|\bsd\b|None|\[")
UNSURE = re.compile(r"\b(may be missing|perhaps|up to \w+ causes)\b", re.IGNORECASE)
NUMBER = r"(\d[\d.e+-]*)"


def kept(report: dict[str, Any]) -> dict[str, Any]:
    """What the first sentence of an answer is made of."""
    out = {name: report[name] for name in KEPT}
    out["laws"] = [law["name"] for law in (report["described"] or {}).get("laws", [])]
    out["gates"] = [g for g in report["gates"] if g["name"] == "laws not looked for"]
    out["causes"] = [
        {
            k: v
            for k, v in c.items()
            if k not in ("smallest_visible", "note") or c["note"][:4] == "data"
        }
        for c in report["causes"]
        if c["status"] in TOLD or c["helps"] or c["name"] in report["named"]
    ]
    return out


def answer_of(record: dict[str, Any]) -> str:
    """The headline of a record."""
    rows = []
    for c in record["causes"]:
        size = {k: Interval(**v) for k, v in c["size"].items()}
        gain = c["gain"] and Gain(**c["gain"])
        more = {"size": size, "gain": gain, "rivals": tuple(c["rivals"])}
        rows.append(CauseRow(**{**c, **more, "doubts": tuple(c["doubts"])}))
    # a law's verdict is said of a named one
    verdict = "named" if record["verdict"] == "described" else record["verdict"]
    before, named = record["before_test"], tuple(record["named"])
    answer = Answer(
        verdict,
        SimpleNamespace(forms={}),
        tuple(rows),
        tuple(map(tuple, record["rivals"])),
        tuple(GateResult(**g) for g in record["gates"]),
        None,
        named=named,
        best_names=named,
        before_test=before and BeforeTest(before["verdict"], before["statuses"]),
    )
    gain = record["gain"] and Gain(**record["gain"])
    errors = [ErrorRow(**row) for row in record["errors"]]
    return headline(answer, errors, (), gain, record["laws"])


def read(path: Path) -> dict[str, Any]:
    """A record."""
    content: dict[str, Any] = json.loads(path.read_text("utf-8"))
    return content


@pytest.mark.parametrize("path", sorted(HERE.glob("*.json")), ids=lambda path: path.stem)
def test_the_first_sentence_of_an_answer_is_short_and_true(path):
    record = read(path)
    text = answer_of(record)
    first = first_of(text)
    assert len(first.split()) <= 25 and first.endswith(".") and not CODE.search(text), text
    assert all(len(s.split()) <= 25 for s in re.split(r"(?<=\.) (?=[A-Z])", text)), text
    _check_errors(record, first)
    _check_causes(record, first)
    assert ("probably" in text or "without a name" in first) <= ("Not certain: " in text)


def _check_errors(record: dict[str, Any], first: str) -> None:
    """The error before and after is that of one kind of channel over all unseen runs."""
    if not record["errors"]:
        return
    said = [float(n) for n in re.findall(rf"{NUMBER} ", first.partition("error")[2])]
    kinds: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in record["errors"]:
        kinds.setdefault((row["kind"], row["unit"]), []).append(row)

    def rms(rows, name):
        return (sum(r["num_samples"] * r[name] ** 2 for r in rows)
                / sum(r["num_samples"] for r in rows)) ** 0.5  # fmt: skip

    pooled = [[rms(rows, name) for name in ("before", "after", "noise")] for rows in kinds.values()]
    pooled += [[b / n, a / n, n] for b, a, n in pooled]  # over the noise, where there is no unit
    is_told = any(
        said[0] == pytest.approx(b, rel=6e-3)
        and (len(said) < 2 or said[1] == pytest.approx(a, rel=6e-3) or said[1] == float(f"{n:.3g}"))
        for b, a, n in pooled
    )
    assert is_told, (first, pooled)


def _check_causes(record: dict[str, Any], first: str) -> None:
    """Causes are named in the order of what each removes, laws last; what is said to be certain
    is; nothing that removes much is left out."""
    held = [c for c in record["causes"] if c["removes"] is not None]
    low = first.lower()
    place = {c["name"]: low.find(c["words"].partition(",")[0].lower()) for c in held}
    said = [c for c in held if place[c["name"]] >= 0 and c["status"] in TOLD]
    in_order = sorted(said, key=lambda c: (c["name"] in record["laws"], -c["removes"]))
    assert [place[c["name"]] for c in in_order] == sorted(place[c["name"]] for c in said), first
    for row in said:  # what may be zero is not probable
        assert MAY_BE_ZERO not in row["doubts"] or UNSURE.search(first), first
    if " missing" in first and "probably" not in first and not UNSURE.search(first):
        assert all(c["status"] == "certain" for c in said), first
    total = sum(c["removes"] for c in held)
    unsaid = sum(c["removes"] for c in held if place[c["name"]] < 0)
    is_counted = "causes" in first or "leave open" in first or "left open" in first
    assert is_counted or unsaid <= 0.05 * total or not said, first
    if total < 0.5 and len(said) > 1 and record["verdict"] == "named":
        assert "together" in first
    if first.startswith("No cause of the library"):
        of_laws = sum(c["removes"] for c in held if c["name"] in record["laws"])
        assert of_laws > total - of_laws


def main() -> None:
    """Renew the records from kept answers."""
    HERE.mkdir(exist_ok=True)
    for path in sorted(Path(sys.argv[1]).glob("*.json")):
        report = read(path)
        if "causes" in report:
            text = json.dumps(kept(report), indent=1)
            (HERE / path.name).write_text(f"{text}\n", "utf-8")


if __name__ == "__main__":
    main()
