"""Forces that depend on the motion, so strong that a whole window's do not settle at once."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from diffsim.core.errors import ConvergenceError
from diffsim.systems.multicopter import scene as flying
from diffsim.systems.multicopter.effects import drag_by_square
from diffsim.systems.multicopter.scene import Flyer
from tests.systems.test_moments import damped_flight

f64 = torch.float64
SPEED, DRAG = 30.0, 0.5  # m/s, N s^2/m^2 at 1 kg: a third of the speed goes in a step


def dragged(speed: float = SPEED):
    """A flight along x that drag brakes, and where it starts."""
    scene, start = damped_flight(("velocity", "body_rates"))
    start[..., 6], start[..., 11] = speed, 0.0
    return drag_by_square(scene, torch.tensor([DRAG], dtype=f64), None), start


def test_drag_that_runs_away_over_a_window_is_settled_part_by_part(monkeypatch):
    """One start of 6,450 ended the score of a flight."""
    scene, start = dragged()
    time = scene.dt * np.arange(1, 21)
    with torch.no_grad():
        flyer = Flyer(scene, 1)
        found = flyer(start)[0, 0, :, 0].numpy()
        again = flyer(start)[0, 0, :, 0].numpy()  # from its last forces
    want = SPEED / (1.0 + DRAG * SPEED * time)
    np.testing.assert_allclose(found, want, rtol=0.01)
    np.testing.assert_allclose(again, found, rtol=1e-9)
    monkeypatch.setattr(flying, "_PART", 1000)  # the whole window at once
    with torch.no_grad(), pytest.raises(ConvergenceError, match="still change"):
        Flyer(scene, 1)(start)


def test_what_has_run_away_never_counts_as_settled(monkeypatch):
    """Forces of NaN were taken for settled ones: speeds of 1e158 m/s came out."""
    monkeypatch.setattr(flying, "_PART", 1000)
    for speed in (60.0, 1e3, 1e6):
        scene, start = dragged(speed)
        with torch.no_grad(), pytest.raises((ConvergenceError, flying.FlightError)):
            Flyer(scene, 1)(start)


def test_parts_end_where_the_whole_window_does():
    scene, start = dragged(2.0)
    with torch.no_grad():
        whole = Flyer(scene, 1)
        expected = whole(start)
        parts = Flyer(scene, 1)
        thrusts = scene.delivered(start[:, 0, 12:]).clamp(min=0.0)[:, None]
        for end in (5, 10, 15, 20):
            record = parts._settle(start[..., :12], thrusts, end)
    torch.testing.assert_close(flying.read(scene, record), expected, rtol=1e-7, atol=1e-9)
