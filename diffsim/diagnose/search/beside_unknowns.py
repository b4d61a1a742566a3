"""Evidence of sets beside an unknown cause: a force or a drift of any course in time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from diffsim.core.errors import DiffsimError
from diffsim.diagnose.search.evidence import (
    ALONE_NATS,
    KEEP_NATS,
    Hypothesis,
    LaplaceEvidence,
    Weighed,
)
from diffsim.diagnose.search.simulations import NONE, Center, Members
from diffsim.diagnose.search.weighed_sets import Search
from diffsim.identify import Problem
from diffsim.identify.linearization import (
    Linearization,
    linearization_at,
    measured_of,
    record_at,
    whitened,
)

Array = NDArray[np.float64]
LONG_STEP = 0.3  # prior sd: a last step is simulated
STEP_ATOL = 0.05  # prior sd: a smaller step needs no new linearization


def weigh_unknowns(search: Search, center: Center) -> Search:
    """The best set and its subsets, each with every unknown cause, where the set was fitted."""
    places = {search.plain: [NONE]}
    places[center] = [center.members, *(center.members - {i} for i in center.members)]
    lies: dict[Hypothesis, LaplaceEvidence] = {}
    for place, sets in places.items():
        evidence, made = search.simulations.with_unknowns(
            place, search.unknowns, search.num_families
        )
        keys = [Hypothesis(s, u) for s in sets for u in range(len(search.unknowns))]
        new = {key: evidence for key in keys if key not in lies}  # the plain model comes first
        lies |= new
        weighed = {key: evidence.weigh(key) for key in new}
        search = replace(search, simulations=made, weighed={**search.weighed, **weighed})
    for key in sorted(lies, key=lambda h: -search.nats(h)):
        if _could_decide(search, key, center.members):
            search = relinearized(search, key, lies[key])
    return search


def _could_decide(search: Search, key: Hypothesis, best: Members) -> bool:
    """Whether the verdict hangs on how exact this evidence is."""
    ahead, slack = search.nats(key) - search.nats(Hypothesis(best)), search.settings.rival_nats
    if key.effects >= best:
        return abs(ahead - KEEP_NATS) < slack
    return ahead > -ALONE_NATS


def relinearized(search: Search, key: Hypothesis, evidence: LaplaceEvidence) -> Search:
    """A set with an unknown cause, linearized again at its own optimum.

    Where the last step was large, a simulation at its end says what it is worth, if less.
    """
    assert key.unknown is not None
    problem, cause = search.simulations.narrow(key.effects), search.unknowns[key.unknown]
    own = search.simulations.coordinates(key.effects)
    weighed, x0, last = search.weighed[key], evidence.x0[own], None
    try:
        for _ in range(search.settings.unknown_steps - 1):
            if np.abs(weighed.x[own] - x0).max(initial=0.0) < STEP_ATOL:
                break
            at, search = _linearized(search, key.effects, weighed.x[own])
            last = at, cause.responses(problem, at.x)
            x0, weighed = at.x, _weighed_beside(search, problem, *last, own)
        if last is not None and np.abs(weighed.x[own] - x0).max(initial=0.0) > LONG_STEP:
            at, search = _recorded(search, key.effects, weighed.x[own])
            there = replace(last[0], x=at.x, record=at.record)
            simulated = _weighed_beside(search, problem, there, last[1], own)
            weighed = min(weighed, simulated, key=lambda w: w.nats)
    except DiffsimError as error:  # the step left what can be simulated: keep the last
        search = replace(search, failed={**search.failed, key: str(error)})
    return replace(search, weighed={**search.weighed, key: weighed})


def _linearized(search: Search, members: Members, x: Array) -> tuple[Linearization, Search]:
    """A set at a point, or as near as makes no difference where another cause has led."""
    made = search.simulations
    at = made.near(members, x, STEP_ATOL)
    if at is None or len(at.idx) < len(x):
        at = linearization_at(made.narrow(members), x)
        search = replace(search, simulations=made.noted(members, at))
    return at, search


def _recorded(search: Search, members: Members, x: Array) -> tuple[Linearization, Search]:
    """The same without slopes."""
    made = search.simulations
    at = made.near(members, x, STEP_ATOL)
    if at is None:
        record = record_at(made.narrow(members), x)
        at = Linearization(x, record, (), np.zeros((len(record), 0)))
        search = replace(search, simulations=made.noted(members, at))
    return at, search


def _weighed_beside(
    search: Search, problem: Problem, at: Linearization, response: Array, own: list[int]
) -> Weighed:
    """Evidence of all effects of a problem with an unknown cause, in wide coordinates."""
    residual = whitened(problem, measured_of(problem) - at.record)
    jacobian = whitened(problem, at.columns) * problem.stretch(at.x)
    families, unknowns = search.num_families, len(search.unknowns)
    evidence = LaplaceEvidence(problem, at.x, residual, jacobian, [response], families, unknowns)
    narrow = evidence.weigh(Hypothesis(frozenset(range(len(problem.effects))), 0))
    wide = np.zeros((2, len(search.wide.names)))
    wide[:, own] = narrow.x, narrow.sd
    return replace(narrow, x=wide[0], sd=wide[1])
