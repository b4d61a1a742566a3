"""``diffsim diagnose faults``: which groups of runs have a fault, and which."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from diffsim.cli.arguments import study_file
from diffsim.cli.diagnose_progress import progress_bar
from diffsim.core.check import require_choice
from diffsim.core.figures import limits, list_first
from diffsim.core.files import write_json_atomic
from diffsim.core.units import after_number
from diffsim.data.study import Study
from diffsim.data.study_file import load_study
from diffsim.diagnose.faults import FaultReport, FaultVerdict, judge_faults
from diffsim.diagnose.faults.groups import groups_of
from diffsim.systems.registry import setup_of

FAULTS_FILE = "faults.json"
MAX_RUNS = 4  # of a group that are named; the file has all
NEW = "new"  # what new groups are called, with a number if there are several


def with_new(given: str, new: Sequence[Sequence[Path]], facts: Mapping[str, str]) -> Study:
    """A study with recordings that are not in its file, to be judged.

    Args:
        given: What the user called the study.
        new: CSV files, each list a group with one fault or none.
        facts: Facts of the new runs, such as the vehicle; "new_2:vehicle" is one of this group,
            "b.csv:vehicle" one of the group with this file.

    Raises:
        FileNotFoundError: no such study.
        ValueError: the study has no ``faults``, a fact is of no new group, or the new runs cannot
            be read.
    """
    path = study_file(given)
    study = load_study(path, strict=False)
    if study.faults is None:
        raise ValueError(f"{path}: has no `faults`; see `faults` in docs/study_keys.md")
    if not new:
        return study
    keys = study.faults
    entries: list[dict[str, Any]] = []
    labels = new_labels(len(new))
    called = _groups_by_name(labels, new)
    for name in (name for name in facts if ":" in name):
        require_choice("--fact: group or file", name.rpartition(":")[0], list(called))
    for label, files in zip(labels, new, strict=True):
        unknown = dict.fromkeys((keys.known.fact, keys.state or keys.known.fact), "-")
        setup = {**unknown, keys.per: label} | _facts_of(label, facts, called)
        entries += [
            {"name": f"{label} {name}", "file": str(f.resolve()), "use": "test", "setup": setup}
            for name, f in zip(_run_names(files), files, strict=True)
        ]
    return load_study(path, entries, strict=False)


def _run_names(files: Sequence[Path]) -> list[str]:
    """Names of files without their ending; from the second of a name on, with a number."""
    stems = [file.stem for file in files]
    before = [stems[:k].count(stem) for k, stem in enumerate(stems)]
    return [f"{s}_{n + 1}" if n else s for s, n in zip(stems, before, strict=True)]


def _groups_by_name(labels: Sequence[str], new: Sequence[Sequence[Path]]) -> dict[str, str]:
    """New groups by what they may be called: their label, a path, a file's name if no other
    group has one of that name."""
    out = {label: label for label in labels}
    holders: dict[str, set[str]] = {}
    for label, files in zip(labels, new, strict=True):
        out |= {str(file): label for file in files}
        for file in files:
            holders.setdefault(file.name, set()).add(label)
    return {name: next(iter(of)) for name, of in holders.items() if len(of) == 1} | out


def _facts_of(label: str, facts: Mapping[str, str], called: Mapping[str, str]) -> dict[str, str]:
    """Facts of one new group: those of all, then its own."""
    shared = {name: value for name, value in facts.items() if ":" not in name}
    own = ((name.rpartition(":"), value) for name, value in facts.items() if ":" in name)
    return shared | {name: value for (group, _, name), value in own if called[group] == label}


def new_labels(count: int) -> tuple[str, ...]:
    """Labels of new groups."""
    return (NEW,) if count == 1 else tuple(f"{NEW}_{k + 1}" for k in range(count))


def judged(
    study: Study, out: Path, *, groups: Sequence[str] = (), everything: bool = False, seed: int = 0
) -> FaultReport:
    """Judge groups of a study, print and save the verdicts.

    Args:
        study: Study with ``faults``.
        out: Folder of the results.
        groups: Groups to judge; none: those whose fault is not known, or all where all are.
        everything: Judge all groups, those that teach by the others.
        seed: Of the draws of scatter and sizes.
    """
    assert study.faults is not None
    if everything:
        groups = [g.label for g in groups_of(study, study.faults)]
    with progress_bar("faults") as progress:
        report = judge_faults(
            study,
            setup_of(study),
            seed=seed,
            groups=groups,
            progress=lambda done, of: progress("group", done / of, f"{done + 1} of {of}"),
        )
    print(f"{report.headline}\n")
    for line in lines(report):
        print(line)
    print(f"wrote {write_json_atomic(out / FAULTS_FILE, report.to_dict())}")
    return report


def lines(report: FaultReport) -> list[str]:
    """The report as text: scatter, then a paragraph for each group."""
    out = ["Scatter (one sd, 90 % interval):"]
    for row in report.spreads:
        i = row.interval
        out.append(f"  {row.quantities}: {i.value:.3g} ({limits(i.value, i.low, i.high, 2)})")
    for verdict in report.verdicts:
        out += ["", *_paragraph(verdict)]
    known = [v for v in report.verdicts if v.is_right is not None]
    if known:
        right = sum(bool(v.is_right) for v in known)
        out += ["", f"{right} of {len(known)} groups with a known change are named exactly."]
    return out


def _paragraph(verdict: FaultVerdict) -> list[str]:
    said = f" (said: {verdict.said})" if verdict.said not in ("", "-") else ""
    out = [f"{verdict.title}{said}: {verdict.status}", f"  {_of_what(verdict)}"]
    out += [f"  {verdict.words}", f"  next: {verdict.next_words}"]
    for size in verdict.sizes:
        i, unit = size.interval, after_number(size.unit)
        within = limits(i.value, i.low, i.high)
        out.append(f"  {size.words}: {i.value:.3g}{unit} (90 %: {within})")
    if verdict.causes:
        by_runs, by_labels = verdict.lead_by_runs, verdict.lead_by_labels
        out.append(
            f"  ahead of the next explanation by {by_runs:.1f} nats from these runs, "
            f"{by_labels:+.1f} from labels of other groups"
        )
    else:
        out.append(f"  smallest visible: {', '.join(verdict.visible[:4])}")
    if verdict.set_aside:
        out.append(f"  set aside: {'; '.join(verdict.set_aside)}")
    return out


def _of_what(verdict: FaultVerdict) -> str:
    """Runs of a group, by their files where they are new, and what is known of them."""
    names = [run.removeprefix(f"{verdict.group} ") for run in verdict.runs]
    facts = "".join(f"; {name} {value}" for name, value in verdict.facts.items())
    return f"{'runs' if len(names) > 1 else 'run'} {list_first(names, MAX_RUNS)}{facts}"
