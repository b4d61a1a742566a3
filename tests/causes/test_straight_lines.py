"""Whatever is read between uneven samples is what numpy.interp reads, or the sample before."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from diffsim.causes.formulas import _read_at
from diffsim.causes.signals import Grid
from diffsim.systems.ode.input_effects import _hold_input, _join_samples

SECONDS = np.array([0.4, 0.45, 0.7, 0.72, 1.3, 1.31, 1.9])
GRID = Grid.of(SECONDS, 0.06)
TIMES = GRID.times.numpy()
BEFORE = np.searchsorted(SECONDS, TIMES, side="right") - 1


def read_records(u: torch.Tensor) -> torch.Tensor:
    run = SimpleNamespace(time_s=SECONDS)
    return _read_at(u[..., GRID.samples], run, GRID)  # type: ignore[arg-type]


@pytest.mark.parametrize("read", [read_records, lambda u: _join_samples(u, GRID)])
def test_straight_in_between(read):
    u = torch.from_numpy(np.random.default_rng(0).standard_normal((2, len(TIMES))))
    want = [np.interp(TIMES, SECONDS, row) for row in u[:, GRID.samples].numpy()]
    np.testing.assert_allclose(read(u), want, rtol=1e-12, atol=1e-12)


def test_held_in_between():
    u = torch.from_numpy(np.random.default_rng(0).standard_normal((2, len(TIMES))))
    np.testing.assert_array_equal(_hold_input(u, GRID), u[:, GRID.samples][:, BEFORE])
