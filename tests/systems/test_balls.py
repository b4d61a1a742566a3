"""A bouncing, rolling ball against an integrator, and its description."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from diffsim.systems.rigid_body.bouncing import Bounces, ThrownBall, bounced
from diffsim.systems.rigid_body.on_ground import Ball, Laws, impact, time_of_impact
from diffsim.systems.rigid_body.parts import Body
from tests.helpers import numbers

G, LEVEL = 9.81, 0.03


def ground(restitution=0.8, friction=0.0, drag=0.0, slope=0.0, rolling=0.0):
    laws = Laws(
        numbers(friction),
        numbers(rolling),
        torch.zeros(1, 2, dtype=torch.float64),
        numbers(drag),
        numbers(0.4),
        numbers(G),
    )
    zero = numbers(0.0)
    return Bounces(laws, zero, numbers(LEVEL), numbers(restitution), numbers(slope), zero)


def thrown(place, velocity, rolling=(0.0, 0.0)):
    return ThrownBall(numbers(place), numbers(velocity), numbers(rolling))


def integrated(time, place, velocity, restitution, drag):
    """By DOP853 from impact to impact; no friction."""

    def slope(t, y):
        v = y[3:]
        return np.concatenate([v, [0.0, 0.0, -G] - drag * np.linalg.norm(v) * v])

    def gap(t, y):
        return y[2] - LEVEL

    gap.terminal, gap.direction = True, -1
    out, begin, state = np.full((len(time), 3), np.nan), 0.0, np.array([*place, *velocity])
    while begin < time[-1]:
        part = solve_ivp(
            slope,
            (begin, time[-1] + 1.0),
            state,
            events=gap,
            dense_output=True,
            method="DOP853",
            rtol=1e-11,
            atol=1e-12,
        )
        end = part.t_events[0][0]
        inside = (time >= begin) & (time <= end)
        out[inside] = part.sol(time[inside])[:3].T
        state = part.y_events[0][0].copy()
        state[5] *= -restitution
        begin = end
    return out


@pytest.mark.parametrize("drag", [0.0, 0.15])
def test_bounces_agree_with_an_integrator(drag):
    time = np.linspace(0.0, 1.5, 151)
    place, velocity = (0.1, -0.2, 0.8), (2.0, -1.0, 1.5)
    found, speed = bounced(
        thrown(place, velocity), torch.from_numpy(time)[None], ground(0.8, drag=drag)
    )
    expected = integrated(time, place, velocity, 0.8, drag)
    np.testing.assert_allclose(found[0].numpy(), expected, atol=5e-6)
    rise = np.gradient(expected[:, 0], time)
    np.testing.assert_allclose(speed[0, 5:-5, 0].numpy(), rise[5:-5], atol=0.05)


def test_a_ball_settles_and_rolls():
    """It slips until 5/7 of its speed is left, bounces included, and then rolls."""
    time = numbers(*np.linspace(0.0, 6.0, 61))[None]
    ball = thrown((0.0, 0.0, LEVEL + 0.2), (1.4, 0.0, 0.0))
    place, velocity = bounced(ball, time, ground(0.5, friction=0.3))
    assert float(place[0, -1, 2]) == pytest.approx(LEVEL)
    assert float(velocity[0, -1, 0]) == pytest.approx(1.0, abs=1e-5)


def test_restitution_falls_with_speed():
    high, low = (
        bounced(
            thrown((0.0, 0.0, LEVEL + h), (0.0, 0.0, 0.0)),
            numbers(*np.linspace(0.0, 1.0, 400))[None],
            ground(0.8, slope=-0.1),
        )[1]
        for h in (0.8, 0.0509684)  # 4 m/s, 1 m/s
    )
    assert float(low[0, :, 2].max()) == pytest.approx(0.8, abs=0.01)
    speed = np.sqrt(2.0 * G * 0.8)
    expected = 0.8 * np.exp(-0.1 * (speed - 1.0)) * speed
    assert float(high[0, :, 2].max()) == pytest.approx(expected, abs=0.03)


def test_the_impact_of_two_balls_is_that_of_rigid_bodies():
    """Velocities and turning of both after it, by vectors in space, while their surfaces slip."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        places, speeds = rng.normal(size=(2, 2)), rng.normal(size=(2, 2))
        rolls, sidespin = rng.normal(size=(2, 2)), rng.normal()
        n = np.append(places[0] - places[1], 0.0) / np.linalg.norm(places[0] - places[1])
        up, mass, mu, e = np.array([0.0, 0.0, 1.0]), rng.uniform(0.5, 2.0), 0.01, 0.9
        v = np.column_stack([speeds, np.zeros(2)])
        if (v[1] - v[0]) @ n < 0.2:
            continue
        # turning times radius; the surfaces meet at +n of the coming ball, at -n of the other
        w = np.cross(up, np.column_stack([rolls, np.zeros(2)]))
        w[1] += sidespin * up
        slip = v[1] - v[0] + np.cross(w[0] + w[1], n)
        slip -= (slip @ n) * n
        blow = (1.0 + e) * ((v[1] - v[0]) @ n) / (1.0 + 1.0 / mass)  # over the coming ball's mass
        rub = -mu * blow * slip / np.linalg.norm(slip)
        after = [v[0] + (blow * n - rub) / mass, v[1] - blow * n + rub]
        turned = [w[0] + np.cross(n, rub) / 0.4 / mass, w[1] + np.cross(n, rub) / 0.4]
        free = Laws(*(numbers(0.0),) * 2, torch.zeros(1, 2), *(numbers(x) for x in (0.0, 0.4, G)))
        resting, coming = (
            Ball(*(torch.tensor(x[i][None]) for x in (places, speeds, rolls))) for i in (0, 1)
        )
        values = {"restitution": e, "ball_friction": mu, "mass_ratio": mass, "sidespin": sidespin}
        struck, came, lift = impact(
            resting, coming, free, {k: numbers(x) for k, x in values.items()}
        )
        for ball, ends, turns in ((struck, after[0], turned[0]), (came, after[1], turned[1])):
            np.testing.assert_allclose(ball.velocity[0].numpy(), ends[:2], atol=1e-5)
            np.testing.assert_allclose(ball.rolling[0].numpy(), np.cross(turns, up)[:2], atol=1e-5)
        np.testing.assert_allclose(lift.numpy(), [max(after[1][2], 0.0)], atol=1e-5)


def test_air_meets_the_mean_shadow_of_a_box():
    """Over random turns, against that of a ball: shadows add up over the faces that are lit."""
    edges = np.array([0.2, 0.1, 0.03])
    turns = np.random.default_rng(0).normal(size=(200_000, 3))
    faces = np.prod(edges) / edges
    shadow = (np.abs(turns) @ faces / np.linalg.norm(turns, axis=1)).mean()
    volume, area = Body(name="box", box=tuple({"value": x} for x in edges)).volume_and_area()
    assert volume == pytest.approx(np.prod(edges))
    assert area == pytest.approx(1.0 * shadow, rel=5e-3)


@pytest.mark.grad
@pytest.mark.parametrize("which", [0, 1, 2])
def test_the_time_of_an_impact_follows_the_laws_of_motion(which):
    """As differences say: earlier steps of the iteration left their own derivatives in the last,
    0.42 s per unit of rolling resistance for 0.76."""

    def number(*values):
        return torch.tensor(values, dtype=torch.float64)

    def time(values):
        friction, resistance, drag = values
        still = Ball(number(0.5, 0.02), number(0.0, 0.0), number(0.0, 0.0))
        coming = Ball(number(0.0, 0.0), number(1.5, 0.1), number(0.3, 0.0))
        zero = number(0.0, 0.0)
        laws = Laws(friction, resistance, zero, drag, number(0.66)[0], number(9.81)[0])
        return time_of_impact(still, coming, number(0.066)[0], laws)

    at = number(0.25, 0.01, 0.02)
    slope = torch.autograd.functional.jacobian(time, at)[which]
    step = 1e-6 * torch.eye(3, dtype=torch.float64)[which]
    rise = float(time(at + step) - time(at - step)) / 2e-6
    assert float(slope) == pytest.approx(rise, rel=1e-6)
