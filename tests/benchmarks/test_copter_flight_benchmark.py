"""The flight benchmark runs, hovers while it measures, and counts what it says."""

from __future__ import annotations

import pytest
import torch

from benchmarks.copter_flight import passes, row
from benchmarks.harness import Seconds


@pytest.mark.parametrize("kind", ["bare", "drag, wind, lag"])
def test_the_quadcopter_stays_in_the_air(kind):
    torch.manual_seed(0)
    forward = passes(3, 1000, kind, 1)["forward"]
    height = -forward()[:, -1, 2]
    assert bool((height.abs() < 1.0).all())  # a second, from within some decimeters


def test_gradients_are_there():
    grads = passes(3, 20, "bare", 1)["forward + backward"]()
    assert all(float(g.abs().max()) > 0 for g in grads)


def test_rates():
    line = row("name", [Seconds(wall=0.5, cpu=0.25)], 1_000_000)
    assert "2.000 M/s wall" in line
    assert "4.000 M/s CPU" in line
