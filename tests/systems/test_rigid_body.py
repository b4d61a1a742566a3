"""The tossed cube's closed form against an integrator, and impulses against hand calculations."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from diffsim.data.study import Run
from diffsim.systems.rigid_body.layout import PoseLayout
from diffsim.systems.rigid_body.toss import Mass, Tosses, impulse, turned
from diffsim.systems.rigid_body.windows import (
    CORNERS,
    TURN,
    TWIST,
    RecordedPoses,
    continuous,
    first_touch,
)
from tests.helpers import numbers as tensor

GRAVITY, HALF_WIDTH = 9.81, 0.0524
E, MU, INERTIA = 0.3, 0.2, 2.0 / 3.0 * HALF_WIDTH**2
POSE = [*(("position", i) for i in range(3)), *(("quaternion", i) for i in range(4))]


def kick(velocity, arm, restitution=E, friction=MU, rebound=0.0):
    return impulse(
        tensor(*velocity),
        tensor(*arm),
        torch.eye(3, dtype=torch.float64) / INERTIA,
        *(tensor(v)[0] for v in (restitution, friction, rebound)),
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
    setup = {"_corner": float(np.argmin(height)), "_touch_s": 0.1, "_hits": 1.0}
    setup |= {f"_start_{c}": v for c, v in zip(TWIST, [*start[:3], *start[6:]], strict=True)}
    setup |= {f"_start_{c}": v for c, v in zip(TURN, q, strict=True)}
    return Run("toss", time, measured, {}, "toss", setup=setup), start


def integrated(run, start, moments=None):
    """Newton and Euler by DOP853, rotation matrices, the impact found as an event."""
    corner = CORNERS[int(run.setup["_corner"])] * HALF_WIDTH
    moments = np.full(3, INERTIA) if moments is None else moments

    def slope(t, y):
        matrix, w = y[6:15].reshape(3, 3), y[15:]
        skew = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        turning = np.cross(moments * w, w) / moments
        return np.concatenate([y[3:6], [0, 0, -GRAVITY], (matrix @ skew).ravel(), turning])

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
    inverse = (matrix / moments) @ matrix.T
    p = impulse(
        *(torch.from_numpy(v) for v in (y[3:6] + np.cross(matrix @ y[15:], arm), arm, inverse)),
        *(tensor(v)[0] for v in (E, MU, 0.0)),
    ).numpy()
    y[3:6] += p
    y[15:] += matrix.T @ inverse @ np.cross(arm, p)
    two = solve_ivp(slope, (hit, run.time_s[-1]), y, dense_output=True, **options)
    states = np.array([(one if t < hit else two).sol(t) for t in run.time_s])
    return hit, states[:, :3], states[:, 6:15].reshape(-1, 3, 3)


def flown(run, start, mass=None, **terms):
    values = {"restitution": E, "friction": MU, "gravity": GRAVITY, "ground": 0.0}
    values |= {f"edge_{a}": 2.0 * HALF_WIDTH for a in "xyz"}
    known = {n: torch.tensor(v, dtype=torch.float64) for n, v in values.items()}
    layout = PoseLayout(POSE, tensor(1.0, 0.0, 0.0, 0.0))
    tosses = Tosses.of([run])
    at = torch.from_numpy(start)[None, None]
    return tosses.fly(at, known, terms, mass or Mass(), layout)[0, 0].numpy()


def test_flight_and_impact_agree_with_an_integrator():
    run, start = toss()
    hit, position, matrices = integrated(run, start)
    assert 0.05 < hit < 0.2  # the impact lies inside
    out = flown(run, start)
    np.testing.assert_allclose(out[:, :3], position, atol=1e-9)
    found = Rotation.from_quat(out[:, [4, 5, 6, 3]]).as_matrix()
    np.testing.assert_allclose(found, matrices, atol=1e-8)


def test_body_of_unequal_moments_agrees_with_an_integrator():
    run, start = toss()
    moments = INERTIA * np.array([0.7, 1.0, 1.4])
    _, position, matrices = integrated(run, start, moments)
    out = flown(run, start, Mass(tuple(moments), is_even=False))
    np.testing.assert_allclose(out[:, :3], position, atol=1e-7)
    found = Rotation.from_quat(out[:, [4, 5, 6, 3]]).as_matrix()
    np.testing.assert_allclose(found, matrices, atol=1e-6)
    even = flown(run, start)
    assert np.abs(out - even).max() > 1e-3


def test_free_turn_keeps_momentum():
    moments = tensor(1.0, 2.0, 3.0)
    rates = tensor(4.0, 5.0, -3.0)
    turn, now = turned(rates, tensor(0.4)[0], moments)
    held = Rotation.from_quat(turn.numpy()[[1, 2, 3, 0]]).apply((moments * now).numpy())
    np.testing.assert_allclose(held, (moments * rates).numpy(), atol=1e-3)


def test_window_ends_with_the_first_bounce():
    run, start = toss()
    hit, position, matrices = integrated(run, start)
    quaternions = Rotation.from_matrix(matrices).as_quat()[:, [3, 0, 1, 2]]
    pose = np.column_stack([position, continuous(quaternions)])
    half = np.full(3, HALF_WIDTH)
    window = first_touch(RecordedPoses(pose[:, :3], pose[:, 3:]), half, 0.003, 0.0)
    assert window.corner == run.setup["_corner"]
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
