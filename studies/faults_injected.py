"""``python -m studies.faults_injected``: faults of known size in groups that are sound.

Each sound group of a study with ``faults`` is left out of what is learned. One cause at a time is
added to its samples, as the model says it shows, and the group is judged by the others. Sizes are
counted in sd of noise and scatter (lambda); lambda 0 is the group as it is: any name is wrong.

``--held 0.2`` asks instead whether intervals hold this size, given the right causes: in groups that
were changed on purpose, too, by each cause that was not.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from benchmarks.diagnose_published import PUBLISHED
from diffsim.core import interruptible
from diffsim.data.study import Study
from diffsim.data.study_file import load_study
from diffsim.diagnose.faults.given import take_apart
from diffsim.diagnose.faults.groups import Group
from diffsim.diagnose.faults.judging import judged_group
from diffsim.diagnose.faults.learn import GroupPosterior, learn
from diffsim.diagnose.faults.verdict import FaultVerdict
from diffsim.diagnose.search.evidence import VISIBLE
from diffsim.identify.effect import PRIOR_WIDTH
from diffsim.identify.problem import Problem
from diffsim.identify.whitening import WhiteNoise
from diffsim.systems.registry import setup_of

HEAD = "| lambda | cases | right | among rivals | silent | wrong | size in the 90 % interval |"


@dataclass(frozen=True)
class Case:
    """One injected fault and what was said.

    Attributes:
        group: Label of the group.
        cause: The cause; "" for the group as it is.
        size: Its size [unit of the cause].
        level: The same in sd of noise and scatter.
        verdict: What was said.
    """

    group: str
    cause: str
    size: float
    level: float
    verdict: FaultVerdict

    @property
    def outcome(self) -> str:
        """ "right", "rival", "silent" or "wrong"."""
        named = self.verdict.causes
        if not named:
            is_silent = self.verdict.status == "nothing visible"
            return ("silent" if self.cause else "right") if is_silent else "wrong"
        if (self.cause,) == named:
            return "right"
        return "rival" if (self.cause,) in self.verdict.rivals else "wrong"

    @property
    def holds(self) -> bool | None:
        """Whether the interval holds the size; None where the cause is not named."""
        for size in self.verdict.sizes:
            if size.cause == self.cause:
                return size.interval.low <= self.size <= size.interval.high
        return None


def with_cause(learned: GroupPosterior, group: Group, cause: str, size: float) -> Group:
    """A group with one cause added to its samples.

    Args:
        learned: Model and most probable common parameters.
        group: The group.
        cause: The cause.
        size: Its size [unit of the cause].
    """
    problem = learned.problem
    effect = next(e for e in problem.effects if e.name == cause)
    plain = np.zeros(len(problem.names))
    plain[: len(learned.point)] = learned.point
    changed = plain.copy()
    changed[problem.columns_of(effect)[0]] = size / (PRIOR_WIDTH * effect.typical)
    points = [torch.from_numpy(problem.standardized(p)) for p in (plain, changed)]
    runs = []
    for run in group.runs:
        before, after = (problem.predict(run, p).detach().numpy() for p in points)
        runs.append(replace(run, measured=run.measured * after / before))
    return replace(group, runs=tuple(runs))


def cases(
    study: Study, levels: Sequence[float], causes: Sequence[str], only: Sequence[str]
) -> Iterator[Case]:
    """Verdicts on sound groups, with one cause injected at a time.

    Args:
        study: Study with ``faults``.
        levels: Sizes in sd of noise and scatter.
        causes: Causes to inject.
        only: Sound groups to use; none: all.
    """
    setup = setup_of(study)
    given = take_apart(study, setup)
    problem = Problem(setup.model, study.runs, WhiteNoise(study.channels), setup.effects)
    learned = learn(problem, given.layout, given.groups, seed=0, state=given.keys.state)
    typical = {e.name: e.typical for e in setup.effects}
    for group in given.groups:
        if group.known != () or (only and group.label not in only):
            continue
        others = learned.without(group.label)
        as_it_is = judged_group(group, others, given.keys, given.sets, 0, study.channels)
        yield Case(group.label, "", 0.0, 0.0, as_it_is)
        visible = as_it_is.smallest_visible
        for cause in causes:
            for level in levels:
                size = min(visible[cause] * level / VISIBLE, 9.0 * typical[cause])
                made = with_cause(others, group, cause, size)
                said = judged_group(made, others, given.keys, given.sets, 0, study.channels)
                yield Case(group.label, cause, size, level, said)


def held(study: Study, size: float, causes: Sequence[str]) -> Iterator[tuple[str, str, bool]]:
    """Whether intervals hold an injected size, given the right causes: group, cause, answer.

    Args:
        study: Study with ``faults``.
        size: Size of the injected cause [unit of the cause].
        causes: Causes to inject where only such causes act.
    """
    setup = setup_of(study)
    given = take_apart(study, setup)
    problem = Problem(setup.model, study.runs, WhiteNoise(study.channels), setup.effects)
    learned = learn(problem, given.layout, given.groups, seed=0, state=given.keys.state)
    for group in given.groups:
        if group.known is None or not set(group.known) <= set(causes):
            continue
        others = learned.without(group.label)
        for cause in (c for c in causes if c not in group.known):
            made = with_cause(others, group, cause, size)
            right = (*group.known, cause)
            said = judged_group(made, others, given.keys, [right], 0, study.channels)
            case = Case(group.label, cause, size, np.nan, said)
            yield group.label, cause, bool(case.holds)


def table(done: Sequence[Case]) -> list[str]:
    """Rows of what was said, by size."""
    by_level: Mapping[float, list[Case]] = defaultdict(list)
    for case in done:
        by_level[case.level].append(case)
    out = [HEAD, "|" + "---|" * 7]
    for level, rows in sorted(by_level.items()):
        n = Counter(c.outcome for c in rows)
        held = [c.holds for c in rows if c.holds is not None]
        out.append(
            f"| {level:g} | {len(rows)} | {n['right']} | {n['rival']} | {n['silent']} | "
            f"{n['wrong']} | {sum(held)} of {len(held)} |"
        )
    return out


def main(argv: Sequence[str] | None = None) -> None:
    """Print a line for each case, then the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--study", default=str(PUBLISHED / "crazypad.yaml"))
    parser.add_argument("--causes", default="loss_1,loss_2,loss_3,loss_4")
    parser.add_argument("--levels", default="5,6,7,8", help="sizes in sd of noise and scatter")
    parser.add_argument("--groups", help="sound groups, comma between them; default: all")
    parser.add_argument("--held", type=float, help="size that intervals are asked for")
    args = parser.parse_args(argv)
    before, done = time.process_time(), []
    if args.held is not None:
        rows = list(held(load_study(args.study), args.held, args.causes.split(",")))
        missed = ", ".join(f"{group} {cause}" for group, cause, holds in rows if not holds)
        print(f"{sum(r[2] for r in rows)} of {len(rows)} intervals hold; not: {missed}")
        return
    only = args.groups.split(",") if args.groups else ()
    levels = [float(v) for v in args.levels.split(",")]
    for case in cases(load_study(args.study), levels, args.causes.split(","), only):
        done.append(case)
        v = case.verdict
        print(
            f"{case.group} {case.cause} {case.size:.3f} ({case.level:g}): {case.outcome}, "
            f"sound {v.sound:.3f}; {v.status}, {'+'.join(v.causes)}",
            flush=True,
        )
    print("\n".join(table(done)), f"{time.process_time() - before:.0f} CPU s", sep="\n")


if __name__ == "__main__":
    with interruptible():
        main()
