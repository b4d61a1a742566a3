"""Laws that nobody listed, on soft bodies, rods and flights: each through the ports it offers."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml

from diffsim.data.study import Channel, Run, Study
from diffsim.systems.registry import setup_of
from tests.diagnose.discover.answers import few_laws, found
from tests.systems import test_multicopter_description as copter
from tests.systems.rod.test_rod_description import MODEL as ROD
from tests.systems.soft_body.described import TENDON

DAYS = (291.0, 303.0, 296.0, 299.0, 288.0, 305.0, 293.0, 301.0, 290.0, 304.0)  # [K]
USES = ("fit",) * 6 + ("select", "select", "test", "test")
EFFORT = {"max_effects": 1, "num_refits": 2, "max_rounds": 2}


def shown_by(study: Study, run: Run, model: dict) -> np.ndarray:
    """What a model would show in a run, without noise."""
    made = setup_of(replace(study, runs=(run,), model=model))
    with torch.no_grad():
        return made.model.predict(run, made.model.at_prior()).numpy()


def over_days(study: Study, softer: float, sd: float) -> Study:
    """Recordings of a body that is softer by a share for every kelvin above 298."""
    rng, runs = np.random.default_rng(3), []
    for run in study.runs:
        model = copy.deepcopy(study.model)
        young = model["material"]["youngs_modulus"]
        value = yaml.safe_load(str(young["value"]))
        number, *unit = str(value).split()
        soft = float(number) * (1.0 - softer * (run.setup["day_temperature"] - 298.0))
        young["value"] = " ".join([repr(soft), *unit])
        clean = shown_by(study, run, model)
        runs.append(replace(run, measured=clean + sd * rng.standard_normal(clean.shape)))
    return replace(study, runs=tuple(runs))


def finger() -> Study:
    """A finger that a cable bends, one recording a day, of seven days."""
    days = list(enumerate(zip(DAYS, USES, strict=True)))[2:9]
    times = 0.1 * np.arange(9)
    runs = tuple(
        Run(
            f"day_{k}",
            times,
            np.zeros((9, 1)),
            {"pull_m": (0.9 + 0.05 * k) * 1e-3 * np.arange(9)},
            f"day_{k}",
            k,
            use,
            {"day_temperature": warm},
        )
        for k, (warm, use) in days
    )
    model = yaml.safe_load(TENDON)
    model["body"]["bar"]["cells"] = [4, 1, 2]
    model["numerics"]["poses"] = 5
    model |= {"effects": {"only": ["slack", "command_gain", "body_scale"]}, "effort": EFFORT}
    channel = Channel("tip_z_m", "m", "position", 1e-4)
    return Study("finger", "soft_body", (channel,), runs, model=model)


def arm() -> Study:
    """A tendon-driven arm: two poses a day, one under each pair of pulls."""
    names = [f"{m}_{a}" for m in ("middle", "tip") for a in "xyz"]
    pulls = {"left": np.array([1.0, 3.0]), "right": np.array([0.5, 0.5])}
    runs = tuple(
        Run(
            f"day_{k}",
            np.arange(2.0),
            np.zeros((2, len(names))),
            pulls,
            f"day_{k}",
            k,
            use,
            {"day_temperature": warm},
        )
        for k, (warm, use) in enumerate(zip(DAYS, USES, strict=True))
    )
    model = copy.deepcopy(ROD) | {
        "effects": {"only": ["drive_loss", "tendon_friction"]},
        "effort": EFFORT,
    }
    del model["sessions"]
    channels = tuple(Channel(n, "m", "position", 2e-4) for n in names)
    return Study("arm", "rod", channels, runs, model=model)


def entry_of(report):
    """Where the first law that is described enters, and on what it depends."""
    assert report.verdict == "described", report.sentences
    law = report.described.laws[0]
    return law.entry["kind"], law.entry["target"], law.variables


@pytest.mark.cpu(20)  # two diagnoses, laws of every number of a body, causes beside them
@pytest.mark.parametrize(("make", "sd"), [(finger, 1e-4), (arm, 2e-4)])
def test_a_stiffness_that_falls_with_the_days_warmth_is_described(make, sd):
    with few_laws():
        report = found(over_days(make(), 0.02, sd), accept_numerics=True)
    assert entry_of(report) == ("number", "youngs_modulus", ("day temperature",))
    before, after = (
        np.sqrt(np.mean([getattr(row, n) ** 2 for row in report.errors if row.use == "test"]))
        for n in ("before", "after")
    )
    assert after < 1.3 * sd and before > 2.0 * after


def flights_of_a_gyro_that_feels_weight(per_g: float) -> Study:
    """Flights whose yaw rate shows a share of what the accelerometer feels along the axis."""
    study = copter.study(
        kinds=("circle", "dash", "circle", "dash"),
        effects={"only": ["gyro_offset", "sensor_tilt", "rate_damping"]},
        effort=EFFORT,
    )
    names = [c.name for c in study.channels]
    runs, uses = [], ("fit", "fit", "select", "test")
    for use, run in zip(uses, study.runs, strict=True):
        measured = run.measured.copy()
        measured[:, names.index("r")] += per_g * measured[:, names.index("fz")]
        runs.append(replace(run, measured=measured, use=use))
    return replace(study, runs=tuple(runs))


@pytest.mark.cpu(15)  # two diagnoses of flights
def test_a_gyro_that_feels_weight_is_described_though_windows_begin_where_it_says():
    """The start of each window takes in most of such an error: what is left of it tells."""
    with few_laws():
        report = found(flights_of_a_gyro_that_feels_weight(0.02))
    assert entry_of(report) == ("reading", "r", ("fz",))
    law = report.described.laws[0]
    assert law.form == "line"
    size = law.numbers["amplitude"]
    assert size.low < 0.02 < size.high and size.high - size.low < 0.01
    gains = [row for row in report.errors if row.use == "test" and row.unit == "rad/s"]
    assert all(row.after < 0.0055 < 0.02 < row.before for row in gains)
