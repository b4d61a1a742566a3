"""The tossed cube's closed form against an integrator, and impulses against hand calculations."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from diffsim.data.importers.cube_toss import CORNERS, TWIST, continuous, first_impact
from diffsim.data.study import Run
from diffsim.systems.rigid_body.impact import impulse
from diffsim.systems.rigid_body.model import GRAVITY, HALF_WIDTH, Tosses

E, MU, INERTIA = 0.3, 0.2, 2.0 / 3.0 * HALF_WIDTH**2


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def kick(velocity, arm, restitution=E, friction=MU, rebound=0.0):
    return impulse(
        tensor(*velocity),
        tensor(*arm),
        *(tensor(v)[0] for v in (INERTIA, restitution, friction, rebound)),
    ).numpy()


def test_corner_below_the_center():
    straight = kick([0, 0, -2.0], [0, 0, -0.09])
    np.testing.assert_allclose(straight, [0, 0, 2.0 * (1 + E)], atol=1e-12)
    sliding = kick([3.0, 0, -2.0], [0, 0, -0.09])
    np.testing.assert_allclose(sliding, [-MU * 2.0 * (1 + E), 0, 2.0 * (1 + E)], atol=1e-12)
    sticking = kick([0.1, 0, -2.0], [0, 0, -0.09])
    effective = 1.0 / (1.0 + 0.09**2 / INERTIA)
    np.testing.assert_allclose(sticking, [-0.1 * effective, 0, 2.0 * (1 + E)], atol=1e-12)


def test_impulse_obeys_its_laws_and_takes_energy():
    rng = np.random.default_rng(3)
    for _ in range(200):
        turn = Rotation.random(random_state=rng).as_matrix()
        arm = turn @ CORNERS[0] * HALF_WIDTH
        if arm[2] > 0.0:
            arm = -arm
        v, w = rng.normal(size=3), rng.normal(0.0, 5.0, 3)
        before = v + np.cross(w, arm)
        if before[2] > -0.1:
            continue
        p = kick(before, arm)
        v1, w1 = v + p, w + np.cross(arm, p) / INERTIA
        after = v1 + np.cross(w1, arm)
        assert after[2] == pytest.approx(-E * before[2], abs=1e-9)
        assert np.hypot(*p[:2]) <= MU * p[2] * (1 + 1e-9)
        energy = [a @ a + INERTIA * b @ b for a, b in ((v, w), (v1, w1))]
        assert energy[1] <= energy[0] * (1 + 1e-9)


def toss(end=0.25):
    turn = Rotation.from_euler("xyz", [0.5, 0.7, 0.3])
    height = HALF_WIDTH * (turn.as_matrix() @ CORNERS.T)[2]
    time = np.arange(0.0, end, 1.0 / 148.0)
    q = turn.as_quat()[[3, 0, 1, 2]]
    measured = np.tile(np.concatenate([[0.1, -0.2, 0.18], q, [0.0]]), (len(time), 1))
    start = np.array([0.1, -0.2, 0.18, 0, 0, 0, 0.8, -0.4, -0.2, 0.5, -0.8, 2.0])
    setup = {"corner": float(np.argmin(height)), "touch_s": 0.1, "hits": 1.0}
    setup |= {f"start_{c}": v for c, v in zip(TWIST, start[6:], strict=True)}
    return Run("toss", time, measured, {}, "toss", setup=setup), start


def integrated(run, start):
    """Newton and Euler by DOP853, rotation matrices, the impact found as an event."""
    corner = CORNERS[int(run.setup["corner"])] * HALF_WIDTH

    def slope(t, y):
        matrix, w = y[6:15].reshape(3, 3), y[15:]
        skew = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate([y[3:6], [0, 0, -GRAVITY], (matrix @ skew).ravel(), np.zeros(3)])

    def gap(t, y):
        return (y[:3] + y[6:15].reshape(3, 3) @ corner)[2]

    gap.terminal, gap.direction = True, -1
    q = run.measured[0, 3:7]
    matrix = Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix()
    y0 = np.concatenate([start[:3], start[6:9], matrix.ravel(), start[9:]])
    options = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12}
    one = solve_ivp(slope, (0, run.time_s[-1]), y0, events=gap, dense_output=True, **options)
    hit, y = one.t_events[0][0], one.y_events[0][0].copy()
    matrix = y[6:15].reshape(3, 3)
    arm = matrix @ corner
    p = kick(y[3:6] + np.cross(matrix @ y[15:], arm), arm)
    y[3:6] += p
    y[15:] += matrix.T @ np.cross(arm, p) / INERTIA
    two = solve_ivp(slope, (hit, run.time_s[-1]), y, dense_output=True, **options)
    states = np.array([(one if t < hit else two).sol(t) for t in run.time_s])
    return hit, states[:, :3], states[:, 6:15].reshape(-1, 3, 3)


def flown(run, start, **terms):
    values = {"restitution": tensor(E)[0], "friction": tensor(MU)[0]}
    return Tosses.of([run]).fly(torch.from_numpy(start)[None, None], values, terms)[0, 0].numpy()


def test_flight_and_impact_agree_with_an_integrator():
    run, start = toss()
    hit, position, matrices = integrated(run, start)
    assert 0.05 < hit < 0.2  # the impact lies inside
    out = flown(run, start)
    np.testing.assert_allclose(out[:, :3], position, atol=1e-9)
    found = Rotation.from_quat(out[:, [4, 5, 6, 3]]).as_matrix()
    np.testing.assert_allclose(found, matrices, atol=1e-8)


def test_window_ends_with_the_first_bounce():
    run, start = toss()
    hit, position, matrices = integrated(run, start)
    quaternions = Rotation.from_matrix(matrices).as_quat()[:, [3, 0, 1, 2]]
    pose = np.column_stack([position, continuous(quaternions)])
    window = first_impact(pose, HALF_WIDTH)
    assert window.corner == run.setup["corner"]
    assert abs(run.time_s[window.touch] - hit) < 2.0 / 148.0
    assert window.touch <= window.end <= len(pose)


def test_ground_height_moves_the_impact_and_contact_time_delays_the_kick():
    run, start = toss()
    hit, *_ = integrated(run, start)
    plain = flown(run, start)
    lower = flown(run, start, ground_height=tensor(-0.002))
    soft = flown(run, start, contact_time=tensor(0.004))
    before, after = run.time_s < hit, run.time_s > hit + 0.006
    np.testing.assert_allclose(lower[before, :7], plain[before, :7], atol=1e-12)
    assert np.abs(lower - plain)[after].max() > 5e-4
    np.testing.assert_allclose(soft[before], plain[before], atol=1e-12)
    # a kick over 4 ms carries as far as an instant one 2 ms later
    times = run.time_s[after]
    fall = np.array([0, 0, -0.5 * GRAVITY]) * times[:, None] ** 2
    carried = start[:3] + start[6:9] * times[:, None] + fall
    kicked = (plain[after][:, :3] - carried) / (times - hit)[:, None]
    np.testing.assert_allclose((soft - plain)[after][:, :3], -0.002 * kicked, atol=1e-8)
