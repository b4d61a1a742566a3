"""An estimator that knows no drag, against a filter by other formulas and closed forms."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from diffsim.systems.multicopter.estimator import (
    BlindEstimator,
    _follow_errors,
)
from tests.systems import small_copter
from tests.systems.small_copter import Causes
from tests.systems.test_multicopter_description import misfit, study, up

f64 = torch.float64
G, DT = 9.81, 0.004
DRAG, VELOCITY, TILT, HEADING = 0.45, 4.0, 0.054, 0.15


def rates():
    one = torch.ones(1, dtype=f64)
    return DRAG * one, VELOCITY * one, torch.tensor([[VELOCITY, TILT, HEADING]], dtype=f64)


def followed(velocity, force):
    start = torch.zeros(1, 2, 3, dtype=f64)
    return _follow_errors(velocity[None], force[None], start, rates(), DT)[0]


def test_errors_of_a_straight_swing_are_those_of_a_band_pass():
    t = DT * torch.arange(5001, dtype=f64)
    level = torch.tensor([0.0, 0.0, -G], dtype=f64).expand(5000, 3)
    for w in (0.8, 2.3, 6.0):
        velocity = torch.stack([torch.cos(w * t), 0 * t, 0 * t], -1)
        error = followed(velocity, level)[:, 0, 0].numpy()
        s = (np.exp(1j * w * DT) - 1.0) / DT  # of explicit steps; i w of small ones
        assert abs(s - 1j * w) < 0.02 * w
        share = DRAG * s / (s**2 + VELOCITY * s + TILT * G**2)
        late = t.numpy() > 12.0
        expected = (share * np.exp(1j * w * t.numpy())).real
        np.testing.assert_allclose(error[late], expected[late], atol=1e-6)


def test_a_steady_turn_hides_drag_in_the_heading():
    w, speed = 2.2, 1.4
    t = DT * torch.arange(10001, dtype=f64)
    ahead = torch.stack([torch.cos(w * t), torch.sin(w * t), 0 * t], -1)
    inward = torch.stack([-torch.sin(w * t), torch.cos(w * t), 0 * t], -1)
    level = torch.tensor([0.0, 0.0, -G], dtype=f64)
    errors = followed(speed * ahead, (speed * w * inward + level)[:-1])
    share = (errors[:, 0] * ahead).sum(-1) / speed
    assert float(share[: int(4.0 / DT)].max()) > 0.08  # before the heading has given way
    assert abs(float(share[-1])) < 0.01
    # what accelerates the vehicle inward, turned by a small angle, is the drag: angle = drag / w
    assert float(errors[-1, 1, 2].abs()) == pytest.approx(DRAG / w, rel=0.02)


def test_errors_in_a_window_go_on_where_the_record_left_them():
    one = torch.ones(1, dtype=f64)
    gains = rates()[2]
    generator = torch.Generator().manual_seed(1)
    velocity = torch.randn(1, 61, 3, generator=generator, dtype=f64)
    force = torch.randn(1, 60, 3, generator=generator, dtype=f64) + torch.tensor([0.0, 0.0, -G])
    whole = _follow_errors(velocity, force, torch.zeros(1, 2, 3, dtype=f64), rates(), DT)
    blind = BlindEstimator(DRAG * one, gains, whole)
    error, turned = blind.in_windows(
        torch.tensor([20]), velocity[:, None, 20:], force[:, None, 20:], DT
    )
    torch.testing.assert_close(error[:, 0], whole[:, 20:, 0])
    torch.testing.assert_close(turned[:, 0], whole[:, 20:, 1])


A, B, C = 4.0, 0.054, 0.15  # gains of the filter below
DRAG_OF_ROTORS = 1.6e-4  # [N s^2 / (m rad)], 0.6 1/s for the small copter


def as_estimated(f):
    """Columns of a flight as a filter on board shows them: it sees p, gyro and thrust, no drag."""
    dt, often = f.time[1] - f.time[0], 25.0
    place, velocity = f.position[0].copy(), f.velocity[0].copy()
    turn = Rotation.from_matrix(f.rotation[0])
    shown = []
    for k in range(len(f.time)):
        shown.append((velocity.copy(), turn))
        if k + 1 == len(f.time):
            break
        for i in range(10):  # between samples the truth is interpolated
            h, share = 0.1 * dt, 0.1 * (i + 0.5)
            told = f.position[k] + share * (f.position[k + 1] - f.position[k])
            rates = f.rates[k] + share * (f.rates[k + 1] - f.rates[k])
            push = turn.apply([0.0, 0.0, f.specific[k + 1, 2]])
            late = often * (place - told)  # what the velocity is too large by
            place = place + h * (velocity - late)
            velocity = velocity + h * (push - [0.0, 0.0, G] - A * late * [1.0, 1.0, 0.0])
            velocity[2] += h * often * (f.velocity[k, 2] - velocity[2])
            right = -np.array([B, B, C]) * np.cross(push, late * [1.0, 1.0, 0.0])
            turn = Rotation.from_rotvec(h * right) * turn * Rotation.from_rotvec(h * rates)
    estimate = replace(
        f,
        velocity=np.array([v for v, _ in shown]),
        rotation=np.array([t.as_matrix() for _, t in shown]),
    )
    return up(estimate)


def test_a_filter_on_board_that_knows_no_drag_is_found(monkeypatch):
    causes = Causes(speed_drag=DRAG_OF_ROTORS)
    long = lru_cache(lambda kind, of: small_copter.fly(kind, of, seconds=4.0, fine=4))
    monkeypatch.setattr("tests.systems.test_multicopter_description.flight", long)
    sensors = {
        "position": ["x", "y", "z"],
        "velocity": ["vx", "vy", "vz"],
        "quaternion": {"columns": ["qw", "qx", "qy", "qz"], "order": "wxyz"},
        "body_rates": ["p", "q", "r"],
    }
    keys = {
        "kinds": ("circle",),
        "causes": causes,
        "sensors": sensors,
        "windows": {"length": 0.4},
        "estimator": {"velocity": A, "tilt": B, "heading": C},
        "effects": {"only": ["rotor_speed_drag", "blind_estimator"]},
    }
    estimated = study(as_estimated, **keys)
    drag = 4.0 * DRAG_OF_ROTORS * 470.0 / small_copter.MASS
    without = misfit(estimated, rotor_speed_drag=DRAG_OF_ROTORS)
    right = misfit(estimated, rotor_speed_drag=DRAG_OF_ROTORS, blind_estimator=drag)
    assert right < 1.8
    assert without > 10.0 * right
    # the same flight, shown as it was
    true = study(up, **keys)
    assert misfit(true, rotor_speed_drag=DRAG_OF_ROTORS) < 1.2
