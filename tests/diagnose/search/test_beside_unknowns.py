"""Sets beside unknown causes: what is simulated for one serves the others."""

from dataclasses import replace

import numpy as np
import torch

from diffsim.diagnose.search import fitted_sets as beside_unknowns
from diffsim.diagnose.search.evidence import Hypothesis
from diffsim.identify.unknown import UnknownDrift
from tests.diagnose import linear
from tests.diagnose.search.test_scan import searched

SET = frozenset({0})


def bent():
    """An effect whose slope at zero does not lead to its optimum at once."""

    def apply(scene, size, run):
        moved = linear.shapes("push", run)[..., 0] * torch.sinh(0.2 * size[..., 0])
        return replace(scene, record=scene.record + moved)

    return replace(linear.line("push"), apply=apply)


def relinearized(search, evidence, keys):
    """Evidence of hypotheses one after the other, and how many simulations each took."""
    model, nats, counts = search.null.case.model, [], []
    for key in keys:
        before = model.simulations.count
        search = beside_unknowns.relinearized(search, key, evidence)
        nats.append(search.nats(key))
        counts.append(model.simulations.count - before)
    return nats, counts


def test_unknown_causes_share_the_simulations_of_a_set():
    drifts = tuple(UnknownDrift(i, f"drift {i}") for i in range(2))
    search = searched((bent(),), {linear.line("push"): 2.0}, unknowns=drifts)
    search = replace(search, simulations=replace(search.simulations, at_unknowns={}))
    evidence, _ = search.simulations.with_unknowns(
        search.plain, search.unknowns, search.num_families
    )
    keys = [Hypothesis(SET, u) for u in range(2)]
    posteriors = {key: evidence.weigh(key) for key in keys}
    search = replace(search, posteriors={**search.posteriors, **posteriors})
    nats, counts = relinearized(search, evidence, keys)
    assert counts[0] > 0
    assert counts[1] < counts[0]
    alone, _ = relinearized(search, evidence, keys[1:])
    np.testing.assert_allclose(nats[1], alone[0], atol=0.05)
    # once all that follows the best set is spent, evidence stays linear
    linear_nats = [posteriors[key].nats for key in keys]
    late = relinearized(replace(search, ends=search.steps), evidence, keys)
    assert late == (linear_nats, [0, 0]) and linear_nats != nats


def test_what_one_simulation_refutes_takes_no_slopes():
    """Slopes at zero promise a size at which the record is elsewhere altogether."""

    def apply(scene, size, run):
        moved = linear.shapes("push", run)[..., 0] * (size[..., 0] + 5.0 * size[..., 0] ** 3)
        return replace(scene, record=scene.record + moved)

    steep, right = replace(linear.line("steep"), apply=apply), linear.line("push")
    drift = (UnknownDrift(0, "drift"),)
    search = searched((steep, right), {right: 5.0}, unknowns=drift)
    best, key = frozenset({1}), Hypothesis(frozenset({0}), 0)
    evidence, _ = search.simulations.with_unknowns(search.plain, drift, search.num_families)
    ahead = replace(evidence.weigh(key), nats=search.nats(Hypothesis(best)) + 1.0)
    made = replace(search.simulations, at_unknowns={})
    search = replace(search, simulations=made, posteriors={**search.posteriors, key: ahead})
    assert beside_unknowns._could_decide(search, key, best)
    alone = Hypothesis(key.effects)  # fitted after the center, and better
    better = replace(search.posteriors[alone], nats=ahead.nats + 5.0)
    moved = replace(search, posteriors={**search.posteriors, alone: better})
    assert not beside_unknowns._could_decide(moved, key, best)
    model, runs = search.null.case.model, search.wide.runs
    before = model.simulations.count
    found = beside_unknowns._simulated_beside(search, key, search.plain, best)
    assert model.simulations.count == before + len(runs)
    assert found.nats(key) < search.nats(Hypothesis(best)) - 100.0
    # of the best set itself slopes decide
    beside_best = beside_unknowns._simulated_beside(search, key, search.plain, key.effects)
    assert beside_best is search


def test_what_was_simulated_far_away_does_not_serve():
    search = searched((bent(),), {linear.line("push"): 2.0})
    at = search.simulations.fitted[SET]
    made = search.simulations.noted(SET, at)

    def near(members, x, *step):
        return made.near(members, x + np.array(step), 0.05)

    assert near(SET, at.x, 0.0, 0.0, 0.0) is at
    assert near(SET, at.x, 0.04, 0.0, 0.0) is at
    assert near(SET, at.x, 0.0, 0.06, 0.0) is None
    assert near(frozenset(), at.x[:2], 0.0, 0.0) is None
