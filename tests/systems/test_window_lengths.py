"""Windows of flights are as long as the fitted model allows, and their length is said."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose import diagnose
from diffsim.diagnose.checks.gates import windows_gate
from diffsim.systems.multicopter.cutting import LONGEST_S
from diffsim.systems.registry import load_extended, setup_of
from tests.systems import small_copter
from tests.systems.small_copter import COEFFICIENT, RADIUS, Causes
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
