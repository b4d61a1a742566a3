"""``python -m studies.nanobench_torque``: what torque NanoBench's rotors hold against.

Roll and pitch of every flight, from motion capture and commands alone. Thrusts follow commands
times voltage, squared, behind a lag of 50 ms; the torque is that of the data sheet (144 rad/s^2 for
the weight at one arm). Slow is below 1 Hz. Balance, flow and rest are of a regression of the slow
torque on a constant, a trend and the velocity along or across the body.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.signal import butter, filtfilt, lfilter, savgol_filter
from scipy.spatial.transform import Rotation

from benchmarks.nanobench import flying, whole_flights
from diffsim.data.study import Run
from diffsim.systems.multicopter.shooting import filled

FLIGHTS = (
    "B2_circle_slow_rep1",
    "B2_circle_fast_rep1",
    "B3_figure8_medium_rep1",
    "B3_figure8_fast_rep1",
    "B5_helix_fast_rep1",
    "B7_oval_medium_rep1",
    "B9_trefoil_slow_rep1",
)
DT, LAG_S, SLOW_HZ, SHEET = 0.01, 0.05, 1.0, 144.0
SIGNS = {"roll": (-1, -1, 1, 1), "pitch": (-1, 1, 1, -1)}
AHEAD = (15, 30, 50)  # samples over which the torque's gain is asked for
LATE = 4  # samples that commands are late by in that
WINDOW = 50  # samples to each side that tell how late the gyro is


def rows(run: Run) -> list[str]:
    """Table rows of a flight, one per axis."""
    measured = filled(torch.as_tensor(np.asarray(run.measured))).numpy()
    turn = Rotation.from_quat(np.roll(measured[:, 6:10], -1, axis=1))
    velocity = turn.inv().apply(measured[:, 3:6])
    # body rates by the capture: small turns about a sample, differentiated
    steps = (turn[:-1].inv() * turn[1:]).as_rotvec() / DT
    rates = savgol_filter(np.vstack([steps[:1], steps]), 7, 1, axis=0)
    speeds = np.stack([run.command[f"n{k}"] for k in (1, 2, 3, 4)], 1)
    inside = np.flatnonzero(flying(run).numpy())[30:-30]
    speeds = speeds / speeds[inside].mean()
    share = DT / (DT + LAG_S)
    slowed = lfilter([share], [1.0, share - 1.0], speeds, axis=0, zi=(1 - share) * speeds[:1])[0]
    out, late = [], lateness(rates, measured[:, 10:13], inside)
    for axis, (name, signs) in enumerate(SIGNS.items()):
        along = velocity[:, 1 - axis]
        slow = [smooth(x)[inside] for x in (SHEET * slowed**2 @ signs, along)]
        torque = slow[0] - np.gradient(smooth(rates[:, axis]), DT)[inside]
        known = np.stack([np.ones(len(torque)), np.linspace(-1, 1, len(torque)), slow[1]], 1)
        sizes = np.linalg.lstsq(known, torque, rcond=None)[0]
        left = (torque - known @ sizes).std()
        gains = [gain(speeds**2 @ signs, along, rates[:, axis], inside, n) for n in AHEAD]
        numbers = (sizes[0], abs(sizes[2]), torque.std(), left, *gains, *late)
        out.append(
            f"| {run.name[:-5]} | {name} | " + " | ".join(f"{x:.1f}" for x in numbers) + " |"
        )
    return out


def smooth(values: np.ndarray) -> np.ndarray:
    """Its part below ``SLOW_HZ``."""
    return filtfilt(*butter(2, 2.0 * SLOW_HZ * DT), values, axis=0)


def gain(
    asked: np.ndarray, along: np.ndarray, rates: np.ndarray, inside: np.ndarray, ahead: int
) -> float:
    """Change of the rate over some samples, by the torque asked for, velocity, turn, constant."""
    start = inside[:-ahead]
    sums = [
        np.cumsum(x)[start + ahead] - np.cumsum(x)[start]
        for x in (np.roll(asked, LATE), along, rates, np.ones_like(rates))
    ]
    change = rates[start + ahead] - rates[start]
    return float(np.linalg.lstsq(DT * np.stack(sums, 1), change, rcond=None)[0][0])


def lateness(capture: np.ndarray, gyro: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Of the gyro behind the capture, second by second: 10, 50 and 90 % of the flight [ms]."""
    found = []
    for middle in inside[WINDOW:-WINDOW:25]:
        some = slice(middle - WINDOW, middle + WINDOW)
        off = [
            np.square(np.roll(gyro[:, :2], -k, axis=0)[some] - capture[some, :2]).sum()
            for k in range(-12, 13)
        ]
        found.append(1e3 * DT * (np.argmin(off) - 12))
    return np.percentile(found, [10, 50, 90])


def main() -> None:
    """Print the table."""
    print(
        "| flight | axis | balance | flow | slow torque | left | gain 0.15 s | 0.3 | 0.5 | gyro |"
    )
    for run in whole_flights(FLIGHTS).runs:
        print("\n".join(rows(run)))


if __name__ == "__main__":
    main()
