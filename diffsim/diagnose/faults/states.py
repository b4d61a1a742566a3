"""States of a rig that several groups share, such as a set of propellers, often without a note.

A group whose state nobody knows is weighed in every state that was seen, with a probability that
grows with the number of groups in it, and in a new one (Chinese restaurant process, Aldous 1985).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from diffsim.data.fault_keys import FaultKeys
from diffsim.data.study import Run
from diffsim.diagnose.faults.groups import Group
from diffsim.diagnose.faults.learn import GroupPosterior


@dataclass(frozen=True, eq=False)
class State:
    """A state that a group may be in.

    Attributes:
        group: The group, its runs with this state as their fact.
        is_new: Whether nobody has seen it: then the fact is that of any other state.
        log_odds: Logarithm of its probability beforehand.
    """

    group: Group
    is_new: bool
    log_odds: float


def possible_states(group: Group, learned: GroupPosterior, keys: FaultKeys) -> tuple[State, ...]:
    """States that a group may be in; one without further ado where ``state`` is not used.

    Args:
        keys: ``faults`` of the study.
    """
    if keys.state is None:
        return (State(group, False, 0.0),)
    seen = Counter(
        label
        for other, label in learned.states.items()
        if _alike(learned, group, other, label, keys)
    )
    stated = str(group.runs[0].setup.get(keys.state))
    if not group.teaches and stated in seen:
        return (State(group, False, 0.0),)
    if not seen:
        return (State(group, True, 0.0),)
    whole = sum(seen.values()) + 1.0  # the probability of a new state is worth one group
    known = [
        State(_in_state(group, label, keys), False, float(np.log(count / whole)))
        for label, count in seen.items()
    ]
    new = State(known[0].group, True, float(np.log(1.0 / whole)))
    return (*known, new)


def _in_state(group: Group, label: str, keys: FaultKeys) -> Group:
    return replace(group, runs=tuple(_relabel_run(run, label, keys) for run in group.runs))


def _relabel_run(run: Run, label: str, keys: FaultKeys) -> Run:
    return replace(run, setup={**run.setup, str(keys.state): label})


def _alike(learned: GroupPosterior, group: Group, other: str, label: str, keys: FaultKeys) -> bool:
    """Whether another group shares all parameters but those of states: the same vehicle."""
    layout = learned.layout
    own = layout.of(_in_state(group, label, keys).runs)[0]
    return set(own) == set(learned.locals[other].common)
