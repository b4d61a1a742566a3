"""How often each rule speaks of records that are sound, or published: a page of the docs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from diffsim.cli.arguments import described
from diffsim.data.record import RULES, RecordRule, record_findings
from diffsim.data.study import Study
from diffsim.data.study_file import load_study
from labs.records.rigs import ALIKE, SOUND

HEAD = """# How often a rule of the record speaks

[A sound record](diagnose_improving.md#a-sound-record) says what each rule mends. Sound folders are
drawn in the laboratory: rigs without a fault, and lookalikes such as a bounce or a stop.
What a rule says of them is a false alarm. Published recordings may have faults: what is said of
them is a finding and no error. `python -m labs.records --page docs/record_rates.md` writes this
page; below are the copies of master seed {seed}.
"""
DAMAGES_HEAD = """
## Damaged copies

Each fault has a drawn size, in a drawn rig. It is named where the right keys are said, and stopped
where no physics is asked. `python -m labs.records.blame --num 48` asks for first answers of such
copies, and counts those that name a cause.

| fault | named | stopped | of |
|---|---|---|---|"""


def rates_page(
    seed: int, copies: int, room: Path, damaged: Mapping[str, tuple[int, int, int]]
) -> str:
    """The page: a row for each rule, and one for each fault.

    Args:
        seed: Master seed.
        copies: Sound folders of each rig.
        room: Empty folder.
        damaged: Copies of each fault: named, stopped, and all.
    """
    rng = np.random.default_rng(seed)
    sound, published = Counter[str](), Counter[str]()
    folders = 0
    for make in (*SOUND, *ALIKE):
        for _ in range(copies):
            folders += 1
            sound.update(_rules_of(load_study(make(rng).write(room / str(folders)))))
    sets = list(_published())
    for study in sets:
        published.update(_rules_of(study))
    rows = [
        f"| `{rule.name}` | {rule.sees} | {_keys(rule)} | {sound[rule.name]} | "
        f"{published[rule.name]} |"
        for rule in RULES
    ]
    columns = f"| rule | sees | mended by | of {folders} sound folders | of {len(sets)} published |"
    faults = [f"| {name} | {a} | {b} | {c} |" for name, (a, b, c) in damaged.items()]
    sums = " | ".join(str(sum(counts)) for counts in zip(*damaged.values(), strict=True))
    parts = [HEAD.format(seed=seed), columns, "|---|---|---|---|---|", *rows, DAMAGES_HEAD]
    return "\n".join([*parts, *faults, f"| all | {sums} |", ""])


def _keys(rule: RecordRule) -> str:
    return f"`{rule.keys}`" if rule.keys else "left out by the diagnosis"


def _rules_of(study: Study) -> set[str]:
    """Rules that speak of a study, whatever they call what they see."""
    return {finding.rule for finding in record_findings(study)}


def _published() -> Iterator[Study]:
    """Published recordings that are at hand."""
    for path in described():
        try:
            yield load_study(path)
        except (FileNotFoundError, ValueError) as error:  # of a set that was not fetched
            print(f"left out: {path.stem}: {str(error).splitlines()[0]}")


__all__ = ["rates_page"]
