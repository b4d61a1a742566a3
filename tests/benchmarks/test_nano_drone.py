"""The rule of the nano-drone benchmark: by hand, and by its published controls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.ahead import AHEAD, Record, compared, errors_ahead, flown, naive
from benchmarks.nano_drone import MODEL, scores, whole_flights
from diffsim.copter import FlightError
from diffsim.core.errors import DiffsimError
from diffsim.systems.registry import load_extended
from tests.measured import data_folder

f64 = torch.float64


def turning(count: int) -> Record:
    """Flight along x at 2 m/s, turning about z at 0.5 rad/s."""
    t = 0.01 * torch.arange(count, dtype=f64)
    zero, one = torch.zeros_like(t), torch.ones_like(t)
    return Record(
        torch.stack([2.0 * t, zero, zero], -1),
        torch.stack([2.0 * one, zero, zero], -1),
        torch.stack([(0.25 * t).cos(), zero, zero, (0.25 * t).sin()], -1),
        torch.stack([zero, zero, 0.5 * one], -1),
    )


def test_errors_of_holding_everything_are_known():
    truth = turning(120)
    steps = 0.01 * np.arange(1, AHEAD + 1)
    got = errors_ahead(naive(truth), truth).numpy()
    np.testing.assert_allclose(got[:, 0], 2.0 * steps, atol=1e-12)
    np.testing.assert_allclose(got[:, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose(got[:, 2], 0.5 * steps, atol=1e-9)
    np.testing.assert_allclose(got[:, 3], 0.0, atol=1e-12)


def test_a_start_that_cannot_be_flown_is_counted_and_left_out_of_all_models():
    """One start of 6,450 ended the score of a whole flight."""
    truth = turning(120)
    bad = {3, 41, 42}

    def falls(starts: torch.Tensor) -> Record:
        if bad & set(starts.tolist()):
            raise FlightError("no finite state", vehicle=0, step=1)
        return naive(truth)(starts)

    def late(starts: torch.Tensor) -> Record:
        """Another model: off by the number of the start."""
        held = naive(truth)(starts)
        return replace(held, position=held.position + starts[:, None, None])

    found = compared({"falls": falls, "late": late}, truth)
    assert (found.failed, found.num_starts) == ({"falls": 3}, 70)
    kept = [k for k in range(70) if k not in bad]
    all_starts = naive(truth)(torch.tensor(kept))
    gone = truth.after(torch.tensor(kept)).position - all_starts.position
    off = gone - torch.tensor(kept)[:, None, None]
    np.testing.assert_allclose(found.errors["late"][:, 0], off.norm(dim=-1).mean(0))
    np.testing.assert_allclose(found.errors["falls"][:, 0], gone.norm(dim=-1).mean(0), atol=1e-12)
    bad |= set(range(70))
    with pytest.raises(DiffsimError, match="no start can be flown by all models"):
        compared({"falls": falls, "late": late}, truth)


@pytest.mark.reference
def test_published_controls_are_reproduced():
    data_folder("nano_drone")
    rows = dict(scores("melon_a", {}))
    assert rows["naive"] == pytest.approx([17.68, 38.70, 8.16, 28.46], rel=2e-3)
    assert rows["published"] == pytest.approx([2.230, 10.234, 5.021, 28.458], rel=5e-3)


@pytest.mark.reference
def test_flights_start_from_the_recorded_state():
    data_folder("nano_drone")
    study = whole_flights(("random1_4",))
    run = study.runs[0]
    truth = Record.of(torch.as_tensor(run.measured, dtype=f64))
    starts = torch.arange(100, 5700, 50)
    model = load_extended(MODEL, study)  # the plain one lacks the torque of the air
    got = flown(model, run)(starts)
    first = Record(*(v[:, 0] for v in got.parts))
    there = truth.at(starts + 1)
    for a, b, most in zip(first.parts, there.parts, (0.003, 0.02, 0.01, 0.1), strict=True):
        assert float((a - b).norm(dim=-1).median()) < most
