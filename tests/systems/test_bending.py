"""The bending mode against scipy's integrator and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from diffsim.data.study import Run
from diffsim.systems.bending.effects import PRESSURE_SOFTENING, SECOND_MODE, SLOW_COMPLIANCE
from diffsim.systems.bending.response import VALVE
from diffsim.systems.bending.scene import SECOND, Layout, bending_scene
from diffsim.systems.bending.unknown import unknown_moment

LAYOUT = Layout(axes=(0, 1, 2), moving=1, command="p", unit=1.0)
VALUES = {
    "frequency": 6.0,
    "damping_ratio": 0.1,
    "gain": 0.3,
    "slow_time": 0.5,
    "length": 0.1,
    "shape": 0.5,
    "direction": 0.0,
    "neutral_axis": 0.0,
    "center_toward": 0.0,
    "onset": 0.0,
    "release": 0.0,
}
TIME = np.arange(-0.2, 4.0, 0.01)
ON = (TIME > -1e-9) & (TIME < 2.0 - 1e-9)


def scene(**changes):
    run = Run("r", TIME, np.zeros((len(TIME), 3)), {"p": np.where(ON, 1.0, 0.0)}, "g")
    values = {n: torch.tensor(v).double() for n, v in {**VALUES, **changes}.items()}
    return bending_scene(values, run, LAYOUT, {})


def angles(found):
    """From the marker's place on a circular arc: away over along is tan(q / 2)."""
    x = found.simulate().numpy()
    return 2.0 * np.arctan2(x[:, 1], 0.1 + x[:, 0])


def size(value):
    return torch.tensor([value]).double()


@pytest.mark.reference
def test_step_and_release_follow_the_oscillator():
    w = 2.0 * np.pi * VALUES["frequency"]

    def rate(t, y):
        ramp = np.clip((t + 0.5 * VALVE) / VALVE, 0, 1) - np.clip(
            (t - 2 + 0.5 * VALVE) / VALVE, 0, 1
        )
        return [y[1], w * w * (0.3 * ramp - y[0]) - 0.2 * w * y[1]]

    found = solve_ivp(rate, (-0.2, 4.0), [0.0, 0.0], t_eval=TIME, max_step=2e-3, rtol=1e-8)
    # 1 % of the motion: steps of 2 ms, five times that a second after a switch
    np.testing.assert_allclose(angles(scene()), found.y[0], atol=0.003)


def test_a_creeping_softened_body_stays_bounded():
    """Softening acts on both springs: 1 / (1 - k p) of the instant and of the crept compliance."""
    soft = PRESSURE_SOFTENING.apply(scene(slow_time=0.1), size(0.8), None)
    q = angles(SLOW_COMPLIANCE.apply(soft, size(1.0), None))
    assert q[TIME < 1.99][-1] == pytest.approx(0.3 * 2.0 / (1.0 - 0.8), rel=0.02)
    assert abs(q[-1]) < 0.02


def test_second_mode_rings_at_its_frequency():
    plain = angles(scene())
    more = angles(SECOND_MODE.apply(scene(), size(0.2), None)) - plain
    part = more[(TIME > 0.02) & (TIME < 0.5)]
    part = part - part[-1]
    spectrum = np.abs(np.fft.rfft(part * np.hanning(len(part))))
    found = np.fft.rfftfreq(len(part), 0.01)[3:][np.argmax(spectrum[3:])]
    assert found == pytest.approx(6.0 * SECOND, abs=3.0)
    assert part.size and more[TIME < 1.99][-1] == pytest.approx(0.2 * 0.3, rel=0.02)


def test_unknown_moment_is_an_angle_held():
    run = scene().run
    unknown = unknown_moment([run], 5.0)
    knots = torch.full((len(unknown.effect.components),), 0.05, dtype=torch.float64)
    moved = angles(unknown.effect.apply(scene(), knots, run)) - angles(scene())
    assert moved[-1] == pytest.approx(0.05, rel=0.02)
    assert moved[TIME < 1.9][-1] == pytest.approx(0.05, rel=0.02)
    zero = unknown.effect.apply(scene(), 0.0 * knots, run).simulate()
    torch.testing.assert_close(zero, scene().simulate())
