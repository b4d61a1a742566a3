"""Groups of runs with one fault or none."""

from __future__ import annotations

from dataclasses import dataclass

from diffsim.core.check import did_you_mean
from diffsim.data.fault_keys import FaultKeys
from diffsim.data.study import Run, Study


@dataclass(frozen=True, eq=False)
class Group:
    """Runs of one day with the same fault, or none."""

    label: str  # value of the fact that makes the groups
    runs: tuple[Run, ...]  # its runs, by order
    said: str  # what the study says was done; "": nothing
    known: tuple[str, ...] | None  # causes that were changed on purpose; None: not known

    @property
    def facts(self) -> dict[str, str]:
        """Facts of the set-up that all its runs share: what it is called, and what nobody knows
        ("-"), left out."""
        first, *others = (run.setup for run in self.runs)
        return {
            name: str(value)
            for name, value in first.items()
            if str(value) not in ("-", "", self.label, self.said)
            and not name.startswith("_")
            and all(setup.get(name) == value for setup in others)
        }

    @property
    def teaches(self) -> bool:
        """Whether the scatter may be learned from it."""
        return self.known is not None and all(run.use == "fit" for run in self.runs)


def groups_of(study: Study, keys: FaultKeys) -> tuple[Group, ...]:
    """Groups of a study's runs, by their first run.

    Args:
        keys: Its ``faults``.

    Raises:
        ValueError: a run lacks the fact, or one group has two known faults.
    """
    members: dict[str, list[Run]] = {}
    for run in sorted(study.runs, key=lambda r: r.order):
        facts = {"run": run.name, **run.setup}
        if keys.per not in facts:
            hint = did_you_mean(keys.per, run.setup)
            raise ValueError(f"faults.per: run {run.name} has no {keys.per} in its setup{hint}")
        members.setdefault(str(facts[keys.per]), []).append(run)
    return tuple(_group(label, runs, keys) for label, runs in members.items())


def _group(label: str, runs: list[Run], keys: FaultKeys) -> Group:
    said = {str(run.setup.get(keys.known.fact, "")).strip() for run in runs}
    if len(said) > 1:
        raise ValueError(
            f"faults.known: runs of group {label} differ in {keys.known.fact}: {', '.join(said)}"
        )
    what = said.pop()
    return Group(label, tuple(runs), what, keys.known.causes.get(what))
