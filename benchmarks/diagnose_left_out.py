"""``python -m benchmarks.diagnose_left_out``: published sets without a condition, judged on it.

A condition (a pressure, a propeller, the large strokes, the later frames) is left out of everything
and the rest is diagnosed; the frozen model is then judged on what it has never seen, as
``diffsim diagnose judge`` does with a stranger's recordings. ``--only A,B`` and ``--out FILE.md``.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.diagnose_published import PUBLISHED, library_answer
from diffsim.cli.diagnose_inputs import inputs_of
from diffsim.core import interruptible
from diffsim.core.files import write_text_atomic
from diffsim.core.yaml_text import read_yaml_file
from diffsim.data.study import Study
from diffsim.data.study_file import load_study
from diffsim.diagnose.judge.frozen import judge_saved
from diffsim.diagnose.judge.unseen import Unseen
from diffsim.identify.model_file import read_extended

SECOND = (0.95, 1.05)  # where a step has settled [s]
STILL_S = -0.05  # before it
COLUMNS = ("left out", "named", "runs", "of", "before", "after", "outside", "CPU s")
HEAD = f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|"


@dataclass(frozen=True)
class Case:
    """A published set without a condition."""

    study: str  # name of the published set
    unseen: Sequence[str] = ()  # patterns of runs that are left out, and judged
    # entries of ``runs:`` in place of the set's own, if its pieces must be cut otherwise
    only: Sequence[Mapping[str, Any]] = ()
    new: Sequence[Mapping[str, Any]] = ()  # entries of ``runs:`` that are only judged
    settles: bool = False  # whether a step's motion after one second is compared, too


def _propeller(name: str) -> Case:
    return Case("rotor_bench", (name,))


def _sequence(file: str, spacing: float, start: float, end: float, **more: Any) -> dict[str, Any]:
    window = {"from_s": start, "until_s": end, "setup": {"spacing": spacing}}
    return {"name": f"{file}_{start:g}", "file": f"{file}.csv", **window, **more}


FRAMES = {"file": "tracks.csv", "setup": {"block_of": "video"}}
CASES = {
    "arm, 350 mbar, the highest": Case("pneumatic_arm", ("step_350mbar",), settles=True),
    "arm, 450 mbar, 100 beyond": Case(
        "pneumatic_arm",
        new=(
            {
                "file": "step_450mbar.csv",
                "zero_time": 0.41,
                "setup": {"level": 45000, "vent": 5.99},
                "use": "test",
            },
        ),
        settles=True,
    ),
    "arm p25, 375 mbar, the highest": Case("pneumatic_arm_p25", ("p25_375mbar",), settles=True),
    "balls, frames from 171": Case(
        "tennis_balls",
        only=({"name": "seen", **FRAMES, "until_s": 0.35},),
        new=({"name": "later", **FRAMES, "from_s": 0.35, "use": "test"},),
    ),
    "cube, the last ten tosses": Case(
        "cube_toss", tuple(f"toss_{k}" for k in (486, 492, 504, 510, 522, 528, 540, 546, 558, 564))
    ),
    "starfish, all large strokes": Case(
        "starfish",
        only=(
            _sequence("baseline", 0.07717, 0.7, 3.9),
            _sequence("baseline", 0.07717, 8.0, 11.0, missing_if="t < 8.6"),
            _sequence("horizontal_cyclic3", 0.07673, 0.9, 4.1, use="select"),
        ),
        new=(_sequence("horizontal_cyclic1", 0.07369, 1.0, 30.0, use="test"),),
    ),
    "starfish, in air": Case("starfish", new=(_sequence("airtest", 0.062, 0.7, 6.0, use="test"),)),
    "propeller 1": _propeller("?1_*"),
    "propeller 3": _propeller("?3_*"),
    "propeller 4": _propeller("?4_*"),
    "propeller 8": _propeller("?8_*"),
    "propeller KDE 14 in": _propeller("kde2814_14in_*"),
}


def rows(name: str, case: Case) -> list[str]:
    """Lines of the table: what was named without the condition, and errors on it."""
    start = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        known, all_of = _studies(case, Path(folder))
        inputs = inputs_of(known, seed=0)
        report = library_answer(inputs)
        report.save(Path(folder))
        saved = read_extended(Path(folder))
        judged = inputs_of(saved.framed(all_of), seed=0)
        new = {run.name for run in all_of.runs} - {run.name for run in known.runs}
        found = judge_saved(judged, saved, sorted(new & {run.name for run in judged.study.runs}))
    cpu = time.process_time() - start
    named = ", ".join(report.named) or report.verdict
    far = "yes" if found.outside else "no"
    begin, end = f"| {name} | {named} | {len(found.runs)}", f"{far} | {cpu:.0f} |"
    return [
        f"{begin} | {what} | {before} | {after} | {end}"
        for what, before, after in (*_errors(found), *(_after(found, judged.study, case)))
    ]


def _studies(case: Case, folder: Path) -> tuple[Study, Study]:
    """Without the condition, and with it as runs to be judged."""
    source = PUBLISHED / f"{case.study}.yaml"
    content = dict(read_yaml_file(source))
    content["data"] = str(load_study(source).folder)
    if case.only:
        content["runs"] = [dict(entry) for entry in case.only]
    path = write_text_atomic(folder / "study.yaml", _text(content))
    content["runs"] = [*content["runs"], *(dict(entry) for entry in case.new)]
    every = load_study(write_text_atomic(folder / "judged.yaml", _text(content)))

    def is_unseen(run: str) -> bool:
        return any(fnmatchcase(run, pattern) for pattern in case.unseen)

    known = load_study(path)
    known = replace(known, runs=tuple(r for r in known.runs if not is_unseen(r.name)))
    runs = (replace(r, use="test") if is_unseen(r.name) else r for r in every.runs)
    return known, replace(every, runs=tuple(runs))


def _text(content: Mapping[str, Any]) -> str:
    return yaml.safe_dump(dict(content), sort_keys=False)


def _errors(found: Unseen) -> list[tuple[str, str, str]]:
    """Root mean square over the judged runs, by kind of channel."""
    out = []
    for kind, unit in dict.fromkeys((e.kind, e.unit) for e in found.errors):
        own = [e for e in found.errors if (e.kind, e.unit) == (kind, unit)]
        weights = [e.num_samples for e in own]
        before, after = (
            float(np.sqrt(np.average([getattr(e, which) ** 2 for e in own], weights=weights)))
            for which in ("before", "after")
        )
        shown = "" if unit == "-" else f" {unit}"
        out.append((kind, f"{before:.3g}{shown}", f"{after:.3g}{shown}"))
    return out


def _after(found: Unseen, study: Study, case: Case) -> list[tuple[str, str, str]]:
    """Distance of the mean marker after one second, as a share of its motion, three channels by
    axis."""
    out = []
    for run in study.runs if case.settles else ():
        if run.name not in found.predicted:
            continue
        at = (run.time_s >= SECOND[0]) & (run.time_s <= SECOND[1])
        still = run.time_s < STILL_S if (run.time_s < STILL_S).any() else run.time_s <= 0.0

        def place(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
            return np.nanmean(values[rows], axis=0).reshape(3, -1).mean(axis=1)

        rest = place(run.measured, still)
        moved = place(run.measured, at) - rest
        far = [
            np.linalg.norm(place(said, at) - rest - moved) / np.linalg.norm(moved)
            for said in found.predicted[run.name]
        ]
        out.append((f"motion after 1 s of {run.name}", f"{far[0]:.0%}", f"{far[1]:.1%}"))
    return out


def main() -> None:
    """Print the table, case by case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default=";".join(CASES), help="cases, semicolon between them")
    parser.add_argument("--out", type=Path, help="Markdown file that gets the table, too")
    args = parser.parse_args()
    lines = [HEAD]
    print(HEAD)
    for name in args.only.split(";"):
        for line in rows(name, CASES[name]):
            lines.append(line)
            print(line, flush=True)
        if args.out is not None:
            write_text_atomic(args.out, "\n".join(lines) + "\n")


if __name__ == "__main__":
    with interruptible():
        main()
