"""Frequency of what pushes a multicopter and is not in its model, seen in the record alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from diffsim.copter.vehicle.multicopter import GRAVITY
from diffsim.core.arrays import Array
from diffsim.core.rotation import matrix_from_rpy
from diffsim.data.study import Run
from diffsim.systems.multicopter.described import DescribedFlights


def strongest_frequency(flights: DescribedFlights, runs: Sequence[Run]) -> tuple[float, float]:
    """Frequency [Hz] that explains most of the horizontal force left over, and its spread.

    In every run on its own the force is fitted by a constant, by the velocity, and by a sine and a
    cosine; frequencies slower than one period per record are left out.

    Args:
        flights: Recipe of the scenes, whose nominal vehicle the forces are left over by.
        runs: Runs that are fitted.
    """
    records = [_find_residuals(flights, run) for run in runs]
    longest = max(float(t[-1] - t[0]) for t, _, _ in records)
    step = 1.0 / (8 * longest)  # frequencies per inverse length of the longest record
    tried = np.arange(1.0 / longest, 3.0, step)
    if len(tried) == 0:
        return 1.0, 0.5
    left = [sum(_compute_misfit(f, *record) for record in records) for f in tried]
    return float(tried[int(np.argmin(left))]), 0.5 / longest


def _find_residuals(flights: DescribedFlights, run: Run) -> tuple[Array, Array, Array]:
    """Times, accelerations (num_samples, 2) and velocities (num_samples, 2) of a run."""
    record = flights.cutter.record(run)
    known = {
        k: torch.tensor(q.value, dtype=torch.float64)
        for k, q in flights.parameters.quantities.items()
    }
    fleet = flights.nominal_fleet()
    rotation = matrix_from_rpy(record.states[:, 3:6])
    pushed: Tensor = flights.asked(run, known)[0] @ fleet.directions[0] / fleet.mass
    world = (rotation * pushed[:, None]).sum(-1)
    world[:, 2] += GRAVITY
    left = record.acceleration - world
    return run.time_s, left[:, :2].numpy(), record.states[:, 6:8].numpy()


def _compute_misfit(frequency: float, time: Array, left: Array, velocity: Array) -> float:
    angle = 2.0 * np.pi * frequency * time
    known = np.column_stack([np.ones_like(time), velocity, np.sin(angle), np.cos(angle)])
    best = np.linalg.lstsq(known, left, rcond=None)[0]
    return float(((left - known @ best) ** 2).sum())
