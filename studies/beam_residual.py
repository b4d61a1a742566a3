"""The silicone beam's free swing without any simulation: what one oscillator leaves, and why.

python studies/beam_residual.py [--from 0.25] [--until 1.0]

Each row adds one candidate to a damped cosine fitted to the height of the tip's mean marker.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from diffsim.core import interruptible
from diffsim.data.beam import BASE_MARKERS, BeamTrial, load_beam_study, rigid_rotation_deg
from diffsim.data.importers import import_study
from diffsim.data.study_file import find_dataset
from diffsim.data.study import Run
from diffsim.systems.published.silicone_beam import HEIGHT, tip_window

Array = NDArray[np.float64]
FINE_S = 1e-3
SHARE = 1.566  # of a cantilever's lowest mode, seen at the tip, in an even acceleration
CANDIDATES = {
    "damped cosine": "",
    "+ level drifting with log(time)": "L",
    "+ frequency following the amplitude": "LF",
    "+ frequency and damping following it": "LFD",
    "+ even and odd harmonics": "L2",
    "+ a second free oscillation": "LB",
    "+ clamp's vertical motion, one gain": "LS",
}


class Swing:
    """Height of one run from ``start_s`` to ``until_s`` after release, and its clamp's motion."""

    def __init__(self, run: Run, channel: int, start_s: float, until_s: float):
        inside = (run.time_s >= start_s) & (run.time_s <= until_s)
        self.name, self.time = run.name, run.time_s[inside]
        self.height = 1e3 * (run.measured[inside, channel] - run.measured[inside, channel][-1])
        self.is_light = not run.setup["tip_load_mass_kg"] > 0.0
        path = CubicSpline(run.time_s, 1e3 * run.command["support_z_m"])
        self.fine = np.arange(self.time[0], self.time[-1], FINE_S)
        self.shift, self.push = path(self.time), path(self.fine, 2)

    def starts(self, parts: str) -> Array:
        """Parameters to begin with: cosine, sine, frequency, damping, level, then the parts'."""
        own = {"L": [0.0], "F": [0.0], "D": [0.0], "2": [0.0] * 4, "S": [0.0]}
        own["B"] = [0.05, 0.05, 8.7 if self.is_light else 3.0, 0.05]
        frequency = 7.7 if self.is_light else 4.3
        return np.array([1.0, 1.0, frequency, 0.05, 0.0, *(v for p in parts for v in own[p])])

    def shown(self, x: Array, parts: str) -> Array:
        """Heights of the formula [mm]."""
        s = self.time - self.time[0]
        a, b, frequency, ratio, level = x[:5]
        rest = list(x[5:])
        taken: dict[str, list[float]] = {}
        for part in parts:
            count = {"2": 4, "B": 4}.get(part, 1)
            taken[part], rest = rest[:count], rest[count:]
        rate = 2.0 * np.pi * frequency
        died = (1.0 - np.exp(-ratio * rate * s)) / (ratio * rate)
        phase = rate * (s + taken.get("F", [0.0])[0] * died)
        envelope = np.exp(-ratio * rate * (s + taken.get("D", [0.0])[0] * died))
        out = level + envelope * (a * np.cos(phase) + b * np.sin(phase))
        if "L" in parts:
            out = out + taken["L"][0] * np.log(self.time)
        if "2" in parts:
            p, q, r, t = taken["2"]
            out = out + envelope**2 * (p * np.cos(2 * phase) + q * np.sin(2 * phase))
            out = out + envelope**3 * (r * np.cos(3 * phase) + t * np.sin(3 * phase))
        if "B" in parts:
            p, q, f, z = taken["B"]
            other = 2.0 * np.pi * f * s
            out = out + np.exp(-z * other) * (p * np.cos(other) + q * np.sin(other))
        if "S" in parts:
            out = out + taken["S"][0] * self._driven(rate, ratio)
        return np.asarray(out)

    def _driven(self, rate: float, ratio: float) -> Array:
        """What the clamp's motion does to the tip: carried along, and shaken (Duhamel)."""
        since = self.fine - self.fine[0]
        damped = rate * np.sqrt(max(1.0 - ratio**2, 1e-6))
        answer = np.exp(-ratio * rate * since) * np.sin(damped * since) / damped * FINE_S
        shaken = np.convolve(-SHARE * self.push, answer)[: len(since)]
        return np.asarray(self.shift + np.interp(self.time, self.fine, shaken))

    def fit(self, parts: str) -> tuple[Array, Array]:
        """Best parameters from four phases to start with, and what is left [mm]."""

        def left(x: Array) -> Array:
            return self.shown(x, parts) - self.height

        tries = []
        for a in (-2.0, 2.0):
            for b in (-2.0, 2.0):
                start = self.starts(parts)
                start[:2] = a, b
                tries.append(least_squares(left, start, x_scale="jac", max_nfev=400))
        best = min(tries, key=lambda t: float(t.cost))
        return np.asarray(best.x), np.asarray(best.fun)


def sway(trial: BeamTrial) -> str:
    """What the clamp's three markers do from 0.12 to 1.2 s, in words."""
    inside = (trial.time_s > 0.12) & (trial.time_s < 1.2)
    rows = np.searchsorted(trial.recording.time_s - trial.release_s, trial.time_s[inside] - 1e-6)
    places = trial.recording.select(BASE_MARKERS).position_m @ trial.rot_model_from_data.T
    rest = np.median(places[-100:], axis=0)
    pitch = np.array([np.deg2rad(rigid_rotation_deg(rest, places[k])[1]) for k in rows])
    forward = trial.support_displacement_m[inside, 0]
    table = np.column_stack([forward, trial.tip_displacement_m[inside, 2], np.ones(len(rows))])
    found, squares, _, _ = np.linalg.lstsq(table, pitch, rcond=None)
    variance = squares[0] / (len(rows) - table.shape[1]) * np.linalg.inv(table.T @ table)
    sd = np.sqrt(np.diag(variance))
    size = 1e6 * 0.5 * np.ptp(trial.support_displacement_m[inside], axis=0)
    return (
        f"clamp of {trial.name}: +-{size[0]:.0f} um forward, +-{size[2]:.0f} um up; turns by "
        f"{found[0]:.1f} +- {sd[0]:.1f} mrad per mm forward, {found[1]:.2f} +- {sd[1]:.2f} per mm "
        "of tip (markers)"
    )


def main() -> None:
    """Print what every candidate leaves of every run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--from", dest="start_s", type=float, default=0.25, help="after release")
    parser.add_argument("--until", type=float, default=1.0, help="seconds after release")
    given = parser.parse_args()
    study = tip_window(import_study("silicone_beam"), until_s=given.until + 0.2)
    channel = [c.name for c in study.channels].index(HEIGHT)
    swings = [Swing(run, channel, given.start_s, given.until) for run in study.runs]
    print(f"{'rms left, um':<40}" + "".join(f"{s.name:>12}" for s in swings))
    found: dict[str, list[Array]] = {}
    for words, parts in CANDIDATES.items():
        fits = [s.fit(parts) for s in swings]
        left = [1e3 * float(np.sqrt(np.mean(r**2))) for _, r in fits]
        print(f"{words:<40}" + "".join(f"{v:>12.1f}" for v in left))
        found[parts] = [x for x, _ in fits]
    for swing, still, x in zip(swings, found["L"], found["LS"], strict=True):
        print(
            f"{swing.name}: {x[2]:.3f} Hz, damping ratio {x[3]:.4f}, drift {1e3 * x[5]:.0f} um "
            f"per e-fold of time, gain of the clamp {x[6]:.2f}; with the clamp at rest "
            f"{still[2]:.3f} Hz, {still[3]:.4f}"
        )
    folder = find_dataset("silicone_beam")
    assert folder is not None  # it was imported above
    for trial in load_beam_study(folder).trials:
        if not trial.tip_load_mass_kg > 0.0:  # with the weight, markers are half hidden at times
            print(sway(trial))


if __name__ == "__main__":
    with interruptible():
        main()
