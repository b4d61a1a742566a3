"""The rules of the benchmarks of flights: by hand, by published controls, on another simulator."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
import yaml

from benchmarks.ahead import AHEAD, Record, compared, errors_ahead, flown, naive
from benchmarks.ahead_fit import Flights, fitted, free_names, objective, save
from benchmarks.nano_drone import MODEL, scores, whole_flights
from benchmarks.nanobench import EVERY, starts_of
from diffsim.copter import FlightError
from diffsim.core.errors import DiffsimError
from diffsim.data.study import Run
from diffsim.identify.extended import ExtendedModel
from diffsim.systems.registry import load_extended, setup_of
from tests.measured import data_folder
from tests.systems import small_copter
from tests.systems.test_multicopter_description import study

f64 = torch.float64


def turning(count: int) -> Record:
    """Flight along x at 2 m/s, turning about z at 0.5 rad/s."""
    t = 0.01 * torch.arange(count, dtype=f64)
    zero, one = torch.zeros_like(t), torch.ones_like(t)
    return Record(
        torch.stack([2.0 * t, zero, zero], -1),
        torch.stack([2.0 * one, zero, zero], -1),
        torch.stack([(0.25 * t).cos(), zero, zero, (0.25 * t).sin()], -1),
        torch.stack([zero, zero, 0.5 * one], -1),
    )


def test_errors_of_holding_everything_are_known():
    truth = turning(120)
    steps = 0.01 * np.arange(1, AHEAD + 1)
    got = errors_ahead(naive(truth), truth).numpy()
    np.testing.assert_allclose(got[:, 0], 2.0 * steps, atol=1e-12)
    np.testing.assert_allclose(got[:, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose(got[:, 2], 0.5 * steps, atol=1e-9)
    np.testing.assert_allclose(got[:, 3], 0.0, atol=1e-12)


def test_a_start_that_cannot_be_flown_is_counted_and_left_out_of_all_models():
    """One start of 6,450 ended the score of a whole flight."""
    truth = turning(120)
    bad = {3, 41, 42}

    def falls(starts: torch.Tensor) -> Record:
        if bad & set(starts.tolist()):
            raise FlightError("no finite state", vehicle=0, step=1)
        return naive(truth)(starts)

    def late(starts: torch.Tensor) -> Record:
        """Another model: off by the number of the start."""
        held = naive(truth)(starts)
        return replace(held, position=held.position + starts[:, None, None])

    found = compared({"falls": falls, "late": late}, truth)
    assert (found.failed, found.num_starts) == ({"falls": 3}, 70)
    kept = [k for k in range(70) if k not in bad]
    all_starts = naive(truth)(torch.tensor(kept))
    gone = truth.after(torch.tensor(kept)).position - all_starts.position
    off = gone - torch.tensor(kept)[:, None, None]
    np.testing.assert_allclose(found.errors["late"][:, 0], off.norm(dim=-1).mean(0))
    np.testing.assert_allclose(found.errors["falls"][:, 0], gone.norm(dim=-1).mean(0), atol=1e-12)
    bad |= set(range(70))
    with pytest.raises(DiffsimError, match="no start can be flown by all models"):
        compared({"falls": falls, "late": late}, truth)


@pytest.mark.reference
def test_published_controls_are_reproduced():
    data_folder("nano_drone")
    rows = dict(scores("melon_a", {}))
    assert rows["naive"] == pytest.approx([17.68, 38.70, 8.16, 28.46], rel=2e-3)
    assert rows["published"] == pytest.approx([2.230, 10.234, 5.021, 28.458], rel=5e-3)


@pytest.mark.reference
def test_flights_start_from_the_recorded_state():
    data_folder("nano_drone")
    study = whole_flights(("random1_4",))
    run = study.runs[0]
    truth = Record.of(torch.as_tensor(run.measured, dtype=f64))
    starts = torch.arange(100, 5700, 50)
    model = load_extended(MODEL, study)  # the plain one lacks the torque of the air
    got = flown(model, run)(starts)
    first = Record(*(v[:, 0] for v in got.parts))
    there = truth.at(starts + 1)
    for a, b, most in zip(first.parts, there.parts, (0.003, 0.02, 0.01, 0.1), strict=True):
        assert float((a - b).norm(dim=-1).median()) < most


def test_starts_fly_until_the_last_sample_compared():
    time = 0.01 * np.arange(400)
    measured = np.zeros((400, 13))
    measured[100:300, 2] = 1.0  # height: on the ground before and after
    measured[200, 2] = np.nan  # a gap of the record
    run = Run("flight", time, measured, {"mean_command": np.full(400, 0.8)}, "flight")
    starts = starts_of(run).numpy()
    assert list(starts) == [*range(100, 150, EVERY), *range(210, 300 - AHEAD, EVERY)]


def test_a_drone_on_the_ground_has_no_starts():
    measured = np.ones((200, 13))
    run = Run("idle", 0.01 * np.arange(200), measured, {"mean_command": np.full(200, 0.3)}, "idle")
    assert not len(starts_of(run))


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
