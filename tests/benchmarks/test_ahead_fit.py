"""Sizes fitted by the rule of the nano-drone benchmark, on flights of another simulator."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
import yaml

from benchmarks.ahead import AHEAD, Record, errors_ahead, flown, naive
from benchmarks.ahead_fit import Flights, fitted, free_names, objective, save
from diffsim.identify.extended import ExtendedModel
from diffsim.systems.registry import load_extended, setup_of
from tests.systems import small_copter
from tests.systems.test_multicopter_description import study

SENSORS = {
    "position": ["x", "y", "z"],
    "velocity": ["vx", "vy", "vz"],
    "quaternion": {"columns": ["qw", "qx", "qy", "qz"], "order": "wxyz"},
    "body_rates": ["p", "q", "r"],
}
CHANNELS = [*"xyz", "vx", "vy", "vz", "qw", "qx", "qy", "qz", *"pqr"]  # as the rule reads them
HEAVY = 1.06 * small_copter.MASS


@lru_cache
def heavy():
    """Flights of the small copter, described with a mass that is 6 % off."""
    made = study(
        sensors=SENSORS,
        channels=CHANNELS,
        mass={"value": HEAVY, "percent": 5},
        torque_ratio={"value": small_copter.TORQUE_RATIO, "percent": 10},
        windows={"length": 0.1},
        nuisances={"clock": 0.01},
        effects={"only": ["wind"]},
    )
    setup = setup_of(made)
    return made, ExtendedModel(setup.model, (), setup.model.base)


def test_a_fit_by_the_rule_finds_the_mass():
    made, model = heavy()
    flights = Flights(made.runs, 12)
    free = free_names(model, ("torque_ratio",))
    assert "mass" in free and "torque_ratio" not in free
    assert not any("@" in name for name in free)
    values = fitted(model, ["mass"], flights, rounds=4)
    assert values["mass"] == pytest.approx(small_copter.MASS, rel=0.01)
    assert values["torque_ratio"] == pytest.approx(small_copter.TORQUE_RATIO)  # was held
    q = model.at_prior().clone()
    before = objective(flights.errors(model, q))
    names = [p.name for p in model.base]
    at = names.index("mass")
    q[at] = model.base[at].coordinate_of(values["mass"])
    assert objective(flights.errors(model, q)) < 0.5 * before


def test_errors_are_those_of_the_rule_over_holding_everything():
    made, model = heavy()
    run = made.runs[0]
    truth = Record.of(torch.as_tensor(run.measured, dtype=torch.float64))
    starts = torch.arange(12, len(truth.position) - AHEAD, 12)
    got = Flights([run], 12).errors(model, model.at_prior()).norm(dim=-1)  # starts, ahead, columns
    there = errors_ahead(flown(model, run), Record(*truth.parts))  # from every sample
    held = errors_ahead(naive(truth), truth).mean(0)
    assert got.shape == (len(starts), AHEAD // 5, 4)
    last = got[:, -1].mean(0) * held
    assert last.tolist() == pytest.approx(there[-1].tolist(), rel=0.5)
    alone = flown(model, run)(starts)
    off = (alone.position - truth.after(starts).position).norm(dim=-1)[:, 4::5]
    np.testing.assert_allclose((got[..., 0] * held[0]).numpy(), off.numpy(), rtol=1e-9)


def test_values_are_saved_without_what_belongs_to_one_run(tmp_path):
    made, model = heavy()
    values = {p.name: p.value for p in model.base} | {"mass": 0.487}
    path = tmp_path / "extended_model.yaml"
    save(model, values, made.name, path)
    saved = yaml.safe_load(path.read_text())
    assert saved["parameters"]["mass"]["value"] == 0.487
    assert not any("@" in name for name in saved["parameters"])
    again = load_extended(path, replace(made, folder=tmp_path))
    (mass,) = (p for p in again.base if p.name == "mass")
    assert mass.value == pytest.approx(0.487)
