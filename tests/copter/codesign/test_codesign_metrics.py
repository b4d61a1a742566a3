"""Metrics of co-design against formulas and linear programs that were written independently."""

import numpy as np
import pytest
import torch
from scipy.optimize import linprog

from diffsim.copter.codesign import (
    METRICS,
    CurrentModel,
    Demands,
    Limits,
    SearchOptions,
    codesign,
    pareto_front,
)
from diffsim.copter.codesign.pareto import undominated
from diffsim.copter.dynamics.control_metrics import (
    control_authority,
    max_hover_weight,
    rotor_out_margins,
)
from tests.copter.codesign_designs import arm_copter, reference_design

SIX = np.arange(6) * np.pi / 3.0
FIXED = {
    "limits": Limits(free=("attitude",)),
    "spins": "given",
    "search": SearchOptions(num_starts=1),
}


def test_payload_and_its_authority():
    vehicle = arm_copter(SIX).multicopter(arm_copter(SIX).values)
    plain = codesign(arm_copter(SIX), "payload", **FIXED)
    # the prototype of the control metrics solves linear programs of its own
    assert plain.max_weight == pytest.approx(float(max_hover_weight(vehicle)), rel=1e-8)
    assert plain.objective == pytest.approx(float(vehicle.weight) / plain.max_weight, rel=1e-8)
    box = (0.5, 0.3, 0.05)
    held = codesign(arm_copter(SIX), "payload", **FIXED, demands=Demands(authority=box))
    assert held.max_weight == pytest.approx(float(max_hover_weight(vehicle, torque=box)), rel=1e-7)
    assert held.max_weight < plain.max_weight


def test_authority():
    design = arm_copter(SIX)
    result = codesign(design, "authority", **FIXED, demands=Demands(load=0.4))
    expected = control_authority(design.multicopter(design.values), load=0.4 * 9.81)
    assert -result.objective == pytest.approx(float(expected), rel=1e-7)


def test_one_rotor_out():
    design = arm_copter(SIX)
    result = codesign(design, "one_rotor_out", **FIXED)
    margins = rotor_out_margins(design.multicopter(design.values))
    assert result.objective == pytest.approx(1.0 / float(margins.min()), rel=1e-7)


def test_response():
    design, angle = arm_copter(SIX), 0.3
    result = codesign(design, "response", **FIXED, demands=Demands(response_angle=angle))
    vehicle = design.multicopter(design.values)
    lift, torque = -vehicle.force_matrix.numpy()[2], vehicle.torque_matrix.numpy()
    slowest = 0.0
    for axis in np.vstack([np.eye(3)[:2], -np.eye(3)[:2]]):
        rows = np.vstack([np.append(lift, 0.0), np.c_[torque, -vehicle.inertia.numpy() @ axis]])
        held = np.array([float(vehicle.weight), 0.0, 0.0, 0.0])
        bounds = [(0.0, u) for u in vehicle.max_thrusts.tolist()] + [(0.0, None)]
        found = linprog(np.append(np.zeros(6), -1.0), A_eq=rows, b_eq=held, bounds=bounds)
        slowest = max(slowest, 2.0 * np.sqrt(angle / -found.fun))
    assert result.objective == pytest.approx(slowest, rel=1e-6)


def test_currents():
    model = CurrentModel([0.3] * 4, [1.4] * 4)
    design = arm_copter(np.arange(4) * np.pi / 2.0, body=(0.0, 0.0, 0.0))
    result = codesign(design, {"current": 1.0, "max_current": 2.0}, currents=model, **FIXED)
    share = float(design.multicopter(design.values).weight) / 4.0
    assert result.thrusts.tolist() == pytest.approx([share] * 4, rel=1e-6)
    # by symmetry the start's share is the optimum, and both relative metrics are 1
    assert result.metrics["current"] == pytest.approx(1.0, rel=1e-6)
    assert result.objective == pytest.approx(3.0, rel=1e-6)
    assert model.current(result.thrusts.numpy()).sum() == pytest.approx(4 * 0.3 * share**1.4)


def test_clearance_is_kept():
    design = arm_copter(np.arange(4) * np.pi / 2.0, arm=0.3)
    close = codesign(design, "size", search=SearchOptions(num_starts=2))
    apart = codesign(
        design, "size", limits=Limits(clearance=0.03), search=SearchOptions(num_starts=2)
    )
    positions = apart.vehicle.positions
    distance = torch.cdist(positions[:, :2], positions[:, :2]) + torch.eye(4)
    assert float(distance.min()) == pytest.approx(2 * 0.127 + 0.03, abs=1e-6)
    assert apart.objective > close.objective + 0.1


def test_flight_time_is_minus_size():
    result = codesign(
        arm_copter(SIX),
        "flight_time",
        limits=Limits(extent=1.0),
        search=SearchOptions(num_starts=1),
    )
    # every arm reaches the end of its range
    assert result.s.tolist() == pytest.approx([0.5] * 6, abs=1e-6)
    assert result.metrics["size"] == pytest.approx(2.0, abs=1e-5)


def test_pareto_front():
    front = pareto_front(
        arm_copter(SIX),
        ["payload", "size"],
        num_points=3,
        progress=False,
        search=SearchOptions(num_starts=1),
    )
    payload = [r.metrics["payload"] for r in front]
    size = [r.metrics["size"] for r in front]
    assert len(front) >= 2
    assert payload == sorted(payload)
    assert size == sorted(size, reverse=True)


def test_undominated():
    values = np.array([[1.0, 3.0], [2.0, 2.0], [2.0, 3.0], [3.0, 1.0], [3.0, 1.0]])
    assert undominated(values) == [0, 1, 3]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"objective": "paylod"}, "did you mean 'payload'"),
        ({"objective": {"payload": -1.0}}, "weight of payload"),
        ({"objective": {"payload": 0.0}}, "must name a metric"),
        ({"objective": "current"}, "needs currents"),
        ({"method": "joined"}, "method must be one of"),
        ({"spins": (1.0, 0.5)}, "spins must be 6 values"),
        ({"search": SearchOptions(solver="sqp")}, "solver must be one of"),
        ({"currents": CurrentModel([1.0] * 3, [1.5] * 3), "objective": "current"}, "3 rotors"),
        ({"method": "alternating", "objective": "authority"}, "metric must be one of"),
    ],
)
def test_bad_input(arguments, message):
    with pytest.raises(ValueError, match=message):
        codesign(arm_copter(SIX), **arguments)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Limits(free=("shapes",)), "did you mean 'shape'"),
        (lambda: Limits(clearance=-0.1), "clearance must lie in"),
        (lambda: Demands(authority=(1.0, 2.0)), "torques about x, y, z"),
    ],
)
def test_bad_options(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_nan_in_the_design():
    design = arm_copter(SIX)
    design.b = design.b.clone()
    design.b[3] = float("nan")
    with pytest.raises(ValueError, match="design's inequalities must be finite"):
        codesign(design, "payload")


def test_every_metric_is_described():
    assert all(METRICS.values())
    assert reference_design("quadcopter").values.shape == (8,)
