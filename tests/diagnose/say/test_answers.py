"""First sentences of recorded answers: short, and true to what the record holds.

``python -m tests.diagnose.say.test_answers FOLDER`` renews the records: FOLDER is what
``python -m benchmarks.diagnose_published --quick --json FOLDER`` has kept. A file of it with
``truth`` and ``report`` is a drawn case of ``labs.rates``, whose record goes to ``drawn.json``.
"""

import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from diffsim.core.units import small_scale
from diffsim.diagnose.checks.gates import GateResult
from diffsim.diagnose.faults.verdict import SILENT, FaultReport, FaultVerdict, Size
from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.preconditions import MAY_BE_ZERO, NOISE_ALONE
from diffsim.diagnose.judge.records import CauseRow, ErrorRow, Interval
from diffsim.diagnose.say.headline import first_of, headline
from diffsim.diagnose.say.wording import Answer, BeforeTest

HERE = Path(__file__).parent / "answers"
DRAWN, FAULTS = HERE / "drawn.json", HERE / "faults.json"
KEPT = ("verdict", "named", "rivals", "gain", "before_test", "errors", "unknown_share")
TOLD = ("certain", "likely")
# a name of the user's file stays as it is where it holds a capital letter
CODE = re.compile(r"\b[a-z\d]+_[a-z\d_]+\b|@|\bnats\b|gradient check|and \d+ more|\bsd\b|None|\[")
UNSURE = re.compile(r"\b(may be missing|perhaps|up to \w+ causes)\b", re.IGNORECASE)
OPEN = re.compile("another cause|something (like|without a name)|one of several", re.IGNORECASE)
NUMBER = r"(\d[\d.e+-]*)"


def kept(report: dict[str, Any]) -> dict[str, Any]:
    """What the first sentence of an answer is made of."""
    out = {name: report[name] for name in KEPT}
    out["laws"] = [law["name"] for law in (report["described"] or {}).get("laws", [])]
    out["gates"] = [g for g in report["gates"] if g["name"] == "laws not looked for"]
    asked = {*report["named"], *(name for rival in report["rivals"] for name in rival)}
    out["causes"] = [
        {
            k: v
            for k, v in c.items()
            if k not in ("smallest_visible", "note") or c["note"][:4] == "data"
        }
        for c in report["causes"]
        if c["status"] in TOLD or c["helps"] or c["name"] in asked
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


def _told(path: Path) -> dict[str, dict[str, Any]]:
    """Records of a file by name."""
    content = read(path)
    return content if path == DRAWN else {path.stem: content}


RECORDS = {
    name: record
    for path in sorted(HERE.glob("*.json"))
    if path != FAULTS
    for name, record in _told(path).items()
}


@pytest.mark.parametrize("name", RECORDS)
def test_the_first_sentence_of_an_answer_is_short_and_true(name):
    record = RECORDS[name]
    text = answer_of(record)
    first = first_of(text)
    assert len(first.split()) <= 25 and first.endswith(".") and not CODE.search(text), text
    assert all(len(s.split()) <= 25 for s in re.split(r"(?<=\.) (?=[A-Z])", text)), text
    _check_errors(record, first)
    _check_causes(record, first)
    assert ("probably" in text or "without a name" in first) <= ("Not certain: " in text)
    likely = [" ".join(c["doubts"]) for c in record["causes"] if c["status"] == "likely"]
    if "probably" in first and likely:
        assert not all(NOISE_ALONE in doubts for doubts in likely), first
    if "hidden" in record:
        _check_truth(record, first)


def _check_truth(record: dict[str, Any], first: str) -> None:
    """Nothing is said to be missing for sure but what was hidden, of one that was."""
    if "missing" not in first or UNSURE.search(first) or OPEN.search(first):
        return
    surely = {c["name"] for c in record["causes"] if c["status"] == "certain"}
    assert surely <= {record["hidden"]}, first


@pytest.mark.parametrize("study", read(FAULTS))
@pytest.mark.parametrize("number", [1, 2, 7, 100])
def test_the_first_sentence_on_groups_is_short_and_counts(study, number):
    """Of three groups it said all that is known of each, in 113 words."""
    rows = [_group(row) for row in read(FAULTS)[study][:number]]
    text = FaultReport(study, (), tuple(rows)).headline
    found = [row for row in rows if row.status != SILENT]
    assert len(text.split()) <= 25 and text.endswith("."), text
    if not found:
        assert text.startswith("No fault is visible in ")
        return
    assert text.startswith(f"{len(found)} of {len(rows)} group")
    sure = [row for row in found if row.sound <= 0.05]
    begin = re.split("[,;]", text)[0]
    assert ("probably" in begin) == (len(sure) < len(found)), text
    if often := re.search(r"most often (probably )?(.*) \((\d+) groups\)", text):
        name = next(n for row in found for n, plain in row.plain.items() if plain == often[2])
        own = [row for row in found if name in row.causes]
        assert len(own) == int(often[3])
        assert bool(often[1]) == any(row.status != "certain" for row in own)


def _group(row: dict[str, Any]) -> FaultVerdict:
    """The verdict on one group, of its record."""
    sizes = tuple(Size(s["cause"], "-", Interval(1.0, 0.5, 1.5), s["words"]) for s in row["sizes"])
    return FaultVerdict(
        group=row["group"],
        runs=(row["group"],),
        said="",
        known=None,
        status=row["status"],
        causes=tuple(row["causes"]),
        sound=row["sound"],
        strength=row["strength"],
        sizes=sizes,
        rivals=(),
        sets=(),
        smallest_visible={},
        words="",
        plain=row["plain"],
        files=tuple(row["files"]),
    )


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
    # in the unit in which they are read; over the noise, where there is none
    scales = [small_scale(unit, row[1:])[1] for (_, unit), row in zip(kinds, pooled, strict=True)]
    over_noise = [[b / n, a / n, n] for b, a, n in pooled]
    pooled = [[k * v for v in row] for k, row in zip(scales, pooled, strict=True)] + over_noise
    first_said = 1 if "stays at" in first else 0
    is_told = any(
        said[0] == pytest.approx((b, a)[first_said], rel=6e-3)
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
    # laws last, but where they remove more than what stands beside them
    is_last = "beside" not in first
    in_order = sorted(said, key=lambda c: ((c["name"] in record["laws"]) == is_last, -c["removes"]))
    assert [place[c["name"]] for c in in_order] == sorted(place[c["name"]] for c in said), first
    is_open = UNSURE.search(first) or OPEN.search(first)
    for row in said:  # what may be zero is not probable
        assert MAY_BE_ZERO not in row["doubts"] or is_open, first
    if " missing" in first and not re.search("probably|(?i:nothing is)", first) and not is_open:
        assert all(c["status"] == "certain" for c in said), first
    total = sum(c["removes"] for c in held)
    unsaid = sum(c["removes"] for c in held if place[c["name"]] < 0)
    is_counted = re.search(r"causes|left open|beside (perhaps )?\w+ more", first) or is_open
    assert is_counted or unsaid <= 0.05 * total or not said, first
    if total < 0.5 and len(said) > 1 and record["verdict"] == "named":
        assert "together" in first
    if first.startswith("No cause of the library"):
        of_laws = sum(c["removes"] for c in held if c["name"] in record["laws"])
        assert of_laws > total - of_laws


def _kept_groups(report: dict[str, Any]) -> list[dict[str, Any]]:
    """What the first sentence on groups is made of, those with a fault first."""
    names = ("group", "files", "status", "causes", "sound", "strength", "sizes", "plain")
    rows = [{name: row[name] for name in names} for row in report["verdicts"]]
    for row in rows:
        row["files"] = [Path(file).name for file in row["files"]]
        row["plain"] = {c: words for c, words in row["plain"].items() if c in row["causes"]}
    return sorted(rows, key=lambda row: row["status"] == SILENT)


def _write(path: Path, content: dict[str, Any]) -> None:
    """A line for each entry."""
    lines = [f"{json.dumps(name)}: {json.dumps(value)}" for name, value in content.items()]
    path.write_text("{{\n{}\n}}\n".format(",\n".join(lines)), "utf-8")


def main() -> None:
    """Renew the records from kept answers."""
    HERE.mkdir(exist_ok=True)
    drawn: dict[str, Any] = {}
    groups: dict[str, Any] = {}
    for path in sorted(Path(sys.argv[1]).glob("*.json")):
        report = read(path)
        if "truth" in report:
            drawn[path.stem] = {"hidden": report["truth"]["hidden"], **kept(report["report"])}
        elif "causes" in report:
            text = json.dumps(kept(report), indent=1)
            (HERE / path.name).write_text(f"{text}\n", "utf-8")
        elif "verdicts" in report:
            groups[path.stem] = _kept_groups(report)
    for path, content in ((DRAWN, drawn), (FAULTS, groups)):
        if content:
            _write(path, content)


if __name__ == "__main__":
    main()
