"""Windows of flights: their length, strong forces that settle in them, steps by secants."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch

from diffsim.core.errors import ConvergenceError
from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose import diagnose
from diffsim.diagnose.checks.gates import windows_gate
from diffsim.systems.multicopter import scene as flying
from diffsim.systems.multicopter.cutting import LONGEST_S
from diffsim.systems.multicopter.effects import drag_by_square
from diffsim.systems.multicopter.scene import Flyer
from diffsim.systems.multicopter.secants import Secants
from diffsim.systems.registry import load_extended, setup_of
from tests.systems import small_copter
from tests.systems.small_copter import COEFFICIENT, RADIUS, Causes
from tests.systems.test_moments import damped_flight
from tests.systems.test_multicopter_description import MODEL, SPEEDS, up

SENSORS = {
    "position": ["x", "y", "z"],
    "quaternion": {"columns": ["qx", "qy", "qz", "qw"], "order": "xyzw"},
    "body_rates": ["p", "q", "r"],
}
NAMES = ("x", "y", "z", "qx", "qy", "qz", "qw", "p", "q", "r")
SD = np.array([1e-3] * 3 + [2e-3] * 4 + [5e-3] * 3)


@lru_cache
def near_ground() -> Study:
    """Flights at 11 to 28 cm: the ground gives 1 to 5 % of thrust. The thrust stated is 40 % off,
    so that the plain model leaves the record within a second."""
    rng, runs = np.random.default_rng(1), []
    for order, (kind, use) in enumerate((("low", "fit"), ("lower", "fit"), ("low", "select"))):
        f = small_copter.fly(kind, Causes(ground=1.0), seconds=2.4, fine=2)
        table = up(f)
        measured = np.stack([table[n][1] for n in NAMES], 1)
        measured = measured + SD * rng.standard_normal(measured.shape)
        command = {name: f.speeds[:, i] for i, name in enumerate(SPEEDS)}
        runs.append(Run(f"{kind}_{order}", f.time, measured, command, kind, order, use))
    model = {
        **MODEL,
        "sensors": SENSORS,
        "thrust": {"coefficient": {"value": 1.4 * COEFFICIENT, "percent": 30}},
        "radius": RADIUS,
        "effects": {"only": ["ground_effect", "inflow"]},
    }
    shown = tuple(Channel(n, table[n][0], "any", float(s)) for n, s in zip(NAMES, SD, strict=True))
    return Study("near ground", "multicopter", shown, tuple(runs), model=model)


def test_windows_of_a_wrong_thrust_grow_and_the_ground_is_named(tmp_path):
    study = near_ground()
    setup = setup_of(study)
    assert max(setup.model.short_windows(study.runs).values()) < 0.6 * LONGEST_S
    report = diagnose(
        study, setup.model, setup.effects, seed=0, unknowns=setup.unknowns, settings=setup.settings
    )
    fitted = report.best.problem.model
    assert not fitted.short_windows(study.runs)
    assert not any(g.name == "windows" for g in report.gates)
    ground = next(c for c in report.causes if c.name == "ground_effect")
    assert ground.status == "certain"
    assert 0.9 < ground.size["size"].low < ground.size["size"].high < 1.1
    # a saved model has the same windows
    report.save(tmp_path)
    loaded = load_extended(tmp_path, study)
    assert not loaded.short_windows(study.runs)


def test_short_windows_are_said():
    study = near_ground()
    (gate,) = windows_gate(setup_of(study).model, study.fit_runs)
    assert gate.value < 0.6 * LONGEST_S
    assert "low_0 0.5 s" in gate.note and "for that length only" in gate.note


def test_windows_that_are_long_or_stated_stay():
    study = near_ground()
    right = {**study.model, "thrust": {"coefficient": {"value": COEFFICIENT, "percent": 5}}}
    model = setup_of(replace(study, model=right)).model
    assert model.prepared_at(model.at_prior(), study.fit_runs) is model
    stated = setup_of(replace(study, model={**study.model, "windows": {"length": 0.5}})).model
    assert stated.prepared_at(stated.at_prior(), study.fit_runs) is stated
    assert not stated.short_windows(study.fit_runs)


SPREAD = torch.tensor([0.3, 1.0, 2.0], dtype=torch.float64)
SHARE = 0.5  # of the way that every step leaves


def step_at(x, end):
    """Of a Gauss-Newton step that goes a share of the way to the end, turned a little."""
    turn = torch.tensor([[0.0, 0.1, 0.0], [-0.1, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    slope = SHARE * torch.eye(3, dtype=torch.float64) + turn
    return ((torch.eye(3, dtype=torch.float64) - slope) @ ((end - x) / SPREAD)[..., None])[
        ..., 0
    ] * SPREAD


def test_a_linear_map_is_at_its_end_after_a_few_steps_in_every_window():
    end = torch.tensor([[0.1, -0.4, 0.7], [0.0, 0.2, 0.0]], dtype=torch.float64)
    x, secants, last = torch.zeros_like(end), Secants.none(2, SPREAD), None
    for _ in range(7):  # Broyden's method needs twice the number of unknowns at most
        step = step_at(x, end)
        if last is not None:
            secants = secants.learned(x - last[0], last[1], step)
        last, step = (x, step), secants.ahead(step)
        x = x + step
    torch.testing.assert_close(x, end, atol=1e-9, rtol=0.0)
    plain = torch.zeros_like(end)
    for _ in range(7):
        plain = plain + step_at(plain, end)
    assert float((plain - end).abs().max()) > 1e-3


def test_nothing_known_leaves_steps_as_they_are():
    step = torch.tensor([[0.1, -0.2, 0.3]], dtype=torch.float64)
    torch.testing.assert_close(Secants.none(1, SPREAD).ahead(step), step, atol=1e-15, rtol=0.0)


def test_a_slope_of_one_makes_no_step_endless():
    step = torch.tensor([[0.1, -0.2, 0.3]], dtype=torch.float64)
    slope = torch.eye(3, dtype=torch.float64)[None]
    for near in (1.0, 1.0 - 1e-9):
        torch.testing.assert_close(Secants(SPREAD, near * slope).ahead(step), step)


def test_steps_that_did_not_move_teach_nothing():
    none = Secants.none(1, SPREAD)
    moved = torch.zeros(1, 3, dtype=torch.float64)
    noise = torch.full((1, 3), 1e-12, dtype=torch.float64)
    assert torch.equal(none.learned(moved, noise, -noise).slope, none.slope)


f64 = torch.float64
SPEED, DRAG = 30.0, 0.5  # m/s, N s^2/m^2 at 1 kg: a third of the speed goes in a step


def dragged(speed: float = SPEED):
    """A flight along x that drag brakes, and where it starts."""
    scene, start = damped_flight(("velocity", "body_rates"))
    start[..., 6], start[..., 11] = speed, 0.0
    return drag_by_square(scene, torch.tensor([DRAG], dtype=f64), None), start


def test_drag_that_runs_away_over_a_window_is_settled_part_by_part(monkeypatch):
    """One start of 6,450 ended the score of a flight."""
    scene, start = dragged()
    time = scene.dt * np.arange(1, 21)
    with torch.no_grad():
        flyer = Flyer(scene, 1)
        found = flyer(start)[0, 0, :, 0].numpy()
        again = flyer(start)[0, 0, :, 0].numpy()  # from its last forces
    want = SPEED / (1.0 + DRAG * SPEED * time)
    np.testing.assert_allclose(found, want, rtol=0.01)
    np.testing.assert_allclose(again, found, rtol=1e-9)
    monkeypatch.setattr(flying, "_PART", 1000)  # the whole window at once
    with torch.no_grad(), pytest.raises(ConvergenceError, match="still change"):
        Flyer(scene, 1)(start)


def test_what_has_run_away_never_counts_as_settled(monkeypatch):
    """Forces of NaN were taken for settled ones: speeds of 1e158 m/s came out."""
    monkeypatch.setattr(flying, "_PART", 1000)
    for speed in (60.0, 1e3, 1e6):
        scene, start = dragged(speed)
        with torch.no_grad(), pytest.raises((ConvergenceError, flying.FlightError)):
            Flyer(scene, 1)(start)


def test_parts_end_where_the_whole_window_does():
    scene, start = dragged(2.0)
    with torch.no_grad():
        whole = Flyer(scene, 1)
        expected = whole(start)
        parts = Flyer(scene, 1)
        thrusts = scene.delivered(start[:, 0, 12:]).clamp(min=0.0)[:, None]
        for end in (5, 10, 15, 20):
            record = parts._settle(flying.flight_state(start[0, :, :12]), thrusts, end)
    torch.testing.assert_close(flying.read(scene, record), expected, rtol=1e-7, atol=1e-9)
