"""What docs/measured/nano_drone.md says of the nano drone, with nothing but its description."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.nano_drone import MODEL, scores, whole_flights
from diffsim.cli.diagnose_inputs import read_study
from diffsim.systems.registry import load_extended
from tests.diagnose.discover.answers import answer
from tests.measured import data_folder

pytestmark = pytest.mark.reference
DT = 0.01
ROLL, PITCH, YAW = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]])


@lru_cache
def flight(name):
    data_folder("nano_drone")
    run = whole_flights((name,)).runs[0]
    speeds = np.stack([run.command[f"n{i}"] for i in (1, 2, 3, 4)], 1)
    return run.measured, speeds


def response(name, signs, axis, low, high):
    """Angular acceleration over the signed sum of squared speeds [rad/s^2 per 1e6 rad^2/s^2]."""
    from scipy.signal import csd, welch

    measured, speeds = flight(name)
    pull, rate = 1e-6 * speeds**2 @ signs, measured[:, 10 + axis]
    f, cross = csd(pull, rate, fs=1 / DT, nperseg=256)
    power = welch(pull, fs=1 / DT, nperseg=256)[1]
    at = (f >= low) & (f <= high)
    return f[at], (2j * np.pi * f * cross / power)[at]


@lru_cache
def estimator_errors(name):
    """Errors of velocity and attitude that the model's estimator makes, world of the record."""
    data_folder("nano_drone")
    study = whole_flights((name,))
    model = load_extended(MODEL, study)
    scene = model.scene(study.runs[0], model.at_prior())
    return scene.frames.in_world(scene.estimator.errors[0]).numpy()


def moved_less(name, velocity, first=200, last=None):
    """What positions along the ground moved beyond velocity in 0.3 s, and what velocity gave.

    A clock between the two is fitted away.
    """
    measured, _ = flight(name)
    way = np.cumsum(velocity, axis=0) * DT
    rows = np.arange(first, (last or len(way)) - 31, 7)
    gave = (way[rows + 30] - way[rows])[:, :2]
    moved = (measured[rows + 30, :2] - measured[rows, :2]) - gave
    sound = np.abs(moved).max(1) < 0.08  # no lost samples
    moved, gave, change = moved[sound], gave[sound], (velocity[rows + 30] - velocity[rows])[sound]
    late = (moved * change[:, :2]).sum(0) / (change[:, :2] ** 2).sum(0)
    return moved - late * change[:, :2], gave


def test_velocity_is_too_large_at_some_frequencies_only():
    measured, _ = flight("multisine_2")  # sweeps from slow to fast
    shares = []
    for first, last in ((200, 1000), (4000, 5000)):
        moved, gave = moved_less("multisine_2", measured[:, 3:6], first, last)
        shares.append((moved * gave).sum() / (gave * gave).sum())
    slow, fast = shares
    assert -0.05 < slow < -0.02
    assert -0.12 < fast < -0.09


@pytest.mark.parametrize(
    ("name", "most"), [("random2_2", 0.72), ("random2_4", 0.72), ("multisine_4", 0.8)]
)
def test_an_estimator_without_drag_explains_velocities_of_other_flights(name, most):
    velocity = flight(name)[0][:, 3:6]
    scale = 0.089  # what serves all flights best
    by_scale, _ = moved_less(name, (1.0 - scale) * velocity)
    by_estimator, _ = moved_less(name, velocity - estimator_errors(name)[:, 0])
    assert np.abs(by_estimator).mean() < most * np.abs(by_scale).mean()


@pytest.mark.parametrize("name", ["random1_2", "random2_2"])
def test_attitude_leaves_its_gyro_as_that_estimator_does(name):
    """Where it corrects itself attitude does not follow from rates; positions are not used here."""
    measured, _ = flight(name)
    shown = Rotation.from_quat(np.roll(measured[:, 6:10], -1, axis=1))
    rates = measured[:, 10:13]
    steps = Rotation.from_rotvec(DT * 0.5 * (rates[1:] + rates[:-1]))
    errors, left, expected = estimator_errors(name), [], []
    for row in range(300, len(rates) - 60, 40):
        turned = Rotation.identity()
        for k in range(row, row + 40):
            turned = turned * steps[k]
        left.append((shown[row + 40] * (shown[row] * turned).inv()).as_rotvec())
        expected.append(errors[row + 40, 1] - errors[row, 1])
    left, expected = np.array(left), np.array(expected)
    for axis, least in enumerate((0.8, 0.8, 0.55)):
        assert np.corrcoef(left[:, axis], expected[:, axis])[0, 1] > least


def test_squares_show_torques_below_the_published_and_no_strong_damping():
    published = 54.8
    for signs, axis in ((ROLL, 0), (PITCH, 1)):
        f, ratio = response("square_3", signs, axis, 4.0, 16.0)
        assert 0.74 < np.median(np.abs(ratio)) / published < 0.92
        # damping of 8 1/s would lead by 18 degrees over this band's lower half
        slow = f < 8.0
        drift = np.polyfit(f, np.unwrap(np.angle(ratio)), 1)  # the clock turns with frequency
        left = np.angle(ratio) - np.polyval([drift[0], 0.0], f)
        assert np.degrees(np.mean(left[slow])) < 12.0


def test_yaw_follows_rotors_that_speed_up():
    f, ratio = response("square_3", YAW, 2, 2.0, 16.0)
    grows = np.polyfit(np.log(f), np.log(np.abs(ratio)), 1)[0]
    assert 0.6 < grows < 1.2


def test_named_physics_beats_every_published_column():
    data_folder("nano_drone")
    published_best = (2.3223, 10.4033, 5.1013, 28.9873)
    rows = dict(scores("melon_a", {"named": MODEL}, every=20))
    most = (0.6, 0.62, 0.66, 0.66)
    assert all(a < m * b for a, m, b in zip(rows["named"], most, published_best, strict=True))
    # from the state at the start alone, which is what the published models are given
    alone = dict(scores("melon_a", {"named": MODEL}, every=20, is_past_known=False))
    most = (0.96, 0.78, 0.72, 0.72)
    assert all(a < m * b for a, m, b in zip(alone["named"], most, published_best, strict=True))


@pytest.mark.slow
def test_the_moment_of_the_air_is_named():
    data_folder("nano_drone")
    study = read_study("nano_drone")
    report = answer(study)
    assert report.verdict == "named"
    certain = {row.name for row in report.causes if row.status == "certain"}
    assert {"flow_moment", "blind_estimator"} <= certain
    assert "ground_scale" not in certain
    assert "inertia_zz" in report.findings
    (rates,) = (row for row in report.errors if row.kind == "angular_velocity")
    assert rates.after < 0.5 * rates.before
    assert report.gain is not None and report.gain.low > 0.0
