"""The co-design benchmark: the published problem as general solvers get it, and its report."""

import numpy as np
import pytest

from benchmarks.copter_codesign import OPTIONS, Plan, run_method, starts_of
from benchmarks.copter_codesign_plots import tables
from benchmarks.copter_soft_program import SoftProgram
from diffsim.copter.codesign import CurrentModel
from diffsim.copter.codesign.cases import Demands
from diffsim.copter.codesign.limits import Limits
from diffsim.copter.codesign.steps import soft_energy
from diffsim.copter.codesign.task import Task
from tests.copter.codesign_designs import arm_copter

FOUR = np.arange(4) * np.pi / 2.0
MIX = {"payload": 1.0, "max_current": 0.5, "current": 0.3, "size": 0.2, "cost": 0.1}


def task(weights):
    currents = CurrentModel([0.3] * 4, [1.4] * 4)
    return Task.of(arm_copter(FOUR, body=(0.0, 0.0, 0.0)), weights, Demands(), Limits(), currents)


@pytest.mark.grad
@pytest.mark.parametrize("epigraph", [False, True])
def test_published_problem(epigraph):
    whole = task(MIX)
    soft = SoftProgram(whole, whole.start.spins, OPTIONS, epigraph=epigraph)
    rng = np.random.default_rng(0)
    u = whole.model.vehicle.max_thrusts.numpy() * rng.uniform(0.3, 0.7, 4)
    y = soft.pack(whole.start, u)
    expected = soft_energy(whole, whole.start, u, OPTIONS.relative(soft.rotors))
    assert soft.objective(y)[0] == pytest.approx(expected, rel=1e-10)
    assert soft.energy(y) == pytest.approx(expected, rel=1e-10)
    y = y + 0.01 * rng.standard_normal(len(y))
    step = 1e-6 * np.eye(len(y))
    ahead = np.array([soft.objective(y + h)[0] for h in step])
    behind = np.array([soft.objective(y - h)[0] for h in step])
    np.testing.assert_allclose(soft.objective(y)[1], (ahead - behind) / 2e-6, atol=1e-6)
    for value, slope in ((soft.unit, soft.unit_slope), (soft.above, soft.above_slope)):
        found = np.array([(value(y + h) - value(y - h)) / 2e-6 for h in step]).T
        np.testing.assert_allclose(slope(y), found.reshape(slope(y).shape), atol=1e-7)


def test_methods_and_report():
    pytest.importorskip("cvxpy")
    whole, plan = task({"size": 1.0}), Plan(num_starts=1, max_iters=30, max_rounds=3)
    start = starts_of(whole, 1)[0]
    runs = {m: [run_method(whole, start, m, plan)] for m in ("joint (ours)", "SQP, epigraph")}
    assert runs["joint (ours)"][0]["hard"] == pytest.approx(0.0, abs=1e-6)
    assert len(runs["SQP, epigraph"][0]["curve"]) >= 2
    text = tables({"size": {**runs, "active set, epigraph": None}}, None)
    assert "| joint (ours) | 0.0000 |" in text
    assert "not run" in text
