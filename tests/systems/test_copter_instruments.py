"""Sensors of a flight that each have a clock, a lag, a scale and a zero of their own."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.causes.signals import Grid
from diffsim.diagnose import diagnose
from diffsim.systems.multicopter.lag import lagged_in_windows
from diffsim.systems.multicopter.scene import Flyer
from diffsim.systems.registry import setup_of
from tests.systems.test_multicopter_description import MODEL, study

f64 = torch.float64
STEP = 0.02
SENSOR = {"x": "mocap", "y": "mocap", "z": "baro", "p": "imu", "q": "imu", "r": "imu"}
CAMERA = {"qw", "qx", "qy", "qz"}
ONLY = {"position": ["x", "y", "z"], "quaternion": MODEL["sensors"]["quaternion"]} | {
    "body_rates": ["p", "q", "r"]
}


def told(kinds=("circle", "dash"), **keys):
    """Runs of a copter whose cameras, barometer and inertial unit are told apart."""
    made = study(sensors=ONLY, kinds=kinds, **keys)
    kind = {"m": "position", "-": "attitude", "rad/s": "angular velocity"}
    channels = [
        replace(c, kind=kind[c.unit], sensor="mocap" if c.name in CAMERA else SENSOR.get(c.name))
        for c in made.channels
    ]
    return replace(made, channels=tuple(channels))


def late(made, names, delay):
    """The recordings with some channels late, shifted by cubic splines of SciPy."""
    from scipy.interpolate import CubicSpline

    runs = []
    for run in made.runs:
        measured = run.measured.copy()
        for k, channel in enumerate(made.channels):
            if channel.name in names:
                spline = CubicSpline(run.time_s, measured[:, k])
                measured[:, k] = spline(run.time_s - delay)
        first = int(np.ceil(delay / STEP))  # before, nobody knows
        command = {name: u[first:] for name, u in run.command.items()}
        runs.append(
            replace(run, time_s=run.time_s[first:], measured=measured[first:], command=command)
        )
    return replace(made, runs=tuple(runs))


def test_causes_are_tried_for_each_stated_sensor():
    made = told()
    names = {e.name for e in setup_of(made).effects}
    assert {f"sensor_delay_of_{s}" for s in ("mocap", "baro", "imu")} <= names
    assert {"sensor_scale_of_position_of_mocap", "sensor_scale_of_baro"} <= names
    assert {"sensor_lag_of_baro", "sensor_scale_of_imu", "gyro_offset"} <= names
    # the zero of the gyro is a cause already; attitudes have neither scale nor lag by themselves
    assert not {"sensor_offset_of_imu", "sensor_lag_of_mocap", "camera_delay"} & names
    alone = replace(made, channels=tuple(replace(c, sensor=None) for c in made.channels))
    assert "camera_delay" in (plain := {e.name for e in setup_of(alone).effects})
    assert not {n for n in plain if "_of_mocap" in n}


def test_a_late_sensor_shows_what_was_ago():
    made = told(kinds=("circle",), windows={"length": 0.4})
    setup, run = setup_of(made), made.runs[0]
    known = {e.name: e for e in setup.effects}
    scene = setup.model.scene(run, setup.model.at_prior()[None])

    def flown(name="sensor_delay_of_imu", size=0.0):
        there = known[name].apply(scene, torch.tensor([size], dtype=f64), run)
        return Flyer(there, 1)(there.windows.guess[None])[0]

    plain = Flyer(scene, 1)(scene.windows.guess[None])[0]
    torch.testing.assert_close(flown(), plain, atol=1e-12, rtol=0.0)
    names = [c.name for c in made.channels]
    turns = [k for k, name in enumerate(names) if name in CAMERA]

    def of_length_one(y):  # quaternions are shown with the record's length
        y = y.clone()
        y[..., turns] /= y[..., turns].norm(dim=-1, keepdim=True)
        return y

    plain = of_length_one(plain)
    for sensor, own in (("imu", "pqr"), ("baro", "z"), ("mocap", ("x", "y", *CAMERA))):
        moved = of_length_one(flown(f"sensor_delay_of_{sensor}", 2.0 * STEP))
        for k, name in enumerate(names):
            if name in own:
                torch.testing.assert_close(moved[:, 2:, k], plain[:, :-2, k], atol=1e-9, rtol=0.0)
            else:
                torch.testing.assert_close(moved[..., k], plain[..., k])
    louder = flown("sensor_scale_of_imu", 0.1)
    factors = torch.tensor([1.1 if name in "pqr" else 1.0 for name in names], dtype=f64)
    torch.testing.assert_close(of_length_one(louder), plain * factors)


def test_a_lag_in_windows_is_the_exponential_filter():
    t = STEP * torch.arange(30, dtype=f64)
    grid = Grid.even(30, STEP)
    y = (0.3 * t)[None, None, None]  # a steady slope is late by tau
    tau = torch.tensor([0.05], dtype=f64)
    torch.testing.assert_close(lagged_in_windows(y, grid, tau), y - 0.3 * 0.05)
    step = torch.where(t < 0.1, 0.0, 1.0).to(f64)[None, None, None]
    seen = lagged_in_windows(step, grid, tau)[0, 0, 0]
    rise = (t[4:] - 0.08) / STEP  # straight from 0 to 1 between two samples, then exponential
    begun = 0.05 / STEP * (1.0 - np.exp(-STEP / 0.05))
    wanted = 1.0 - begun * torch.exp(-(rise - 1.0) * STEP / 0.05)
    torch.testing.assert_close(seen[5:], wanted[1:], atol=1e-12, rtol=0.0)
    none = torch.zeros(1, dtype=f64)
    torch.testing.assert_close(lagged_in_windows(step, grid, none), step)


@pytest.mark.story  # a further cause of the kind
def test_a_late_barometer_is_named():
    made = late(
        told(kinds=("circle", "dash", "hop"), nuisances={"run_thrust_gain": 0.0}), {"z"}, 0.06
    )
    runs = tuple(replace(r, use="test") if k == 1 else r for k, r in enumerate(made.runs))
    only = ["sensor_delay_of_baro", "sensor_delay_of_imu", "sensor_delay_of_mocap", "delay", "lag"]
    only += ["sensor_lag_of_baro", "sensor_scale_of_baro", "inflow"]
    made = replace(made, runs=runs, model={**made.model, "effects": {"only": only}})
    setup = setup_of(made)
    report = diagnose(
        setup.study or made, setup.model, setup.effects, settings=setup.settings, seed=0
    )
    assert report.named == ("sensor_delay_of_baro",), report.sentences
    (size,) = next(c.size for c in report.causes if c.name in report.named).values()
    assert size.low <= 0.06 <= size.high and size.high - size.low < 0.02
