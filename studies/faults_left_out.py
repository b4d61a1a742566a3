"""``python -m studies.faults_left_out``: groups of CrazyPAD whose whole campaign is unseen.

``diffsim diagnose faults crazypad --all`` judges each group by all others, those of its own
campaign (one vehicle, one kind of change) among them. Here the rest of the campaign is left out,
too, as for a change that nobody has flown before. Groups without a known change must stay silent.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace

from benchmarks.diagnose_published import PUBLISHED
from diffsim.core import interruptible
from diffsim.data.study import Study
from diffsim.data.study_file import load_study
from diffsim.diagnose.faults import judge_faults
from diffsim.diagnose.faults.groups import groups_of
from diffsim.systems.registry import setup_of

HEAD = "| group | said to be | verdict | words | right | CPU s |\n|---|---|---|---|---|---|"


def without_campaign(study: Study, group: str) -> Study:
    """A study without all other groups of one group's campaign."""
    assert study.faults is not None and study.faults.state is not None
    state, per = study.faults.state, study.faults.per
    (campaign,) = {r.setup[state] for r in study.runs if r.setup[per] == group}
    kept = [r for r in study.runs if r.setup[per] == group or r.setup[state] != campaign]
    return replace(study, runs=tuple(kept))


def main(argv: Sequence[str] | None = None) -> None:
    """Print a row for each group."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--groups", help="labels, comma between them; default: all")
    args = parser.parse_args(argv)
    study = load_study(PUBLISHED / "crazypad.yaml")
    assert study.faults is not None
    groups = [g.label for g in groups_of(study, study.faults)]
    print(HEAD)
    for group in args.groups.split(",") if args.groups else groups:
        before = time.process_time()
        rest = without_campaign(study, group)
        (verdict,) = judge_faults(rest, setup_of(rest), seed=0, groups=[group]).verdicts
        spent = time.process_time() - before
        right = {True: "yes", False: "no", None: ""}[verdict.is_right]
        cells = (verdict.group, verdict.said, verdict.status, verdict.words, right, f"{spent:.0f}")
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    with interruptible():
        main()
