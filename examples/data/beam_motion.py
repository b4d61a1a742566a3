"""Numbers from the recordings alone that every simulation is compared with."""

from __future__ import annotations

from typing import Any

import numpy as np

from diffsim.data.signal import noise_std
from examples.data import vibration
from examples.data.beam import BeamStudy, BeamTrial

COMPARE_S = 2.0  # the window of all comparisons: by then the swing is below 1 % of its start
RING_DOWN_START_S = 0.05  # before this the hand still shapes the motion


def describe(study: BeamStudy) -> dict[str, Any]:
    """Numbers of every trial, and how far its repeat is away.

    Returns:
        ``trials``: by name; ``repeats``: by case; lengths in meters.
    """
    return {
        "trials": {trial.name: _trial(trial) for trial in study.trials},
        "repeats": {
            case: _repeat(trials[0], trials[1])
            for case, trials in study.repeats().items()
            if len(trials) >= 2
        },
    }


def ring_down(trial: BeamTrial, until_s: float = COMPARE_S) -> tuple[np.ndarray, np.ndarray]:
    """Time [s] and vertical tip displacement [m] of the free vibration."""
    time_s, tip = trial.after_release(until_s)
    free = time_s >= RING_DOWN_START_S
    return time_s[free], tip[free, 2]


def _trial(trial: BeamTrial) -> dict[str, Any]:
    time_s, tip = trial.after_release()
    decay = vibration.fit_decay(*ring_down(trial))
    turns = vibration.swings(*ring_down(trial))
    level = vibration.settled_level(time_s, tip[:, 2])
    quiet = tip[time_s > time_s[-1] - 1.5]
    clamp = trial.clamp_displacement_m[trial.time_s > 0]
    return {
        "case": trial.case,
        "tip_load_N": trial.tip_load_N,
        "release_s": trial.release_s,
        "release_frame": trial.release_frame,
        "release_frame_detected": trial.release_frame_detected,
        "frequency_Hz": decay.frequency_Hz,
        "frequency_by_turns_Hz": turns.frequency_Hz,
        "damping_ratio": decay.damping_ratio,
        "damping_ratio_by_decrement": turns.damping_ratio,
        "decay_fit_rms_m": decay.rms,
        "level_after_0.1s_m": decay.offset - decay.drift,
        "static_sag_m": -level.value,
        "static_std_m": level.std,
        "creep_share_per_decade": level.creep_per_decade / level.value,
        "lowest_m": float(tip[:, 2].min()),
        "lateral_peak_m": float(np.abs(tip[:, 1] - tip[-100:, 1].mean()).max()),
        "tip_rotation_deg": trial.tip_rotation_deg(),
        "noise_m": [noise_std(quiet[:, axis]) for axis in range(3)],
        "clamp_peak_m": np.nanmax(np.abs(clamp), axis=0) if np.isfinite(clamp).any() else None,
        "by_amplitude": [
            {
                "time_s": begin,
                "amplitude_m": fit.amplitude,
                "frequency_Hz": fit.frequency_Hz,
                "damping_ratio": fit.damping_ratio,
            }
            for begin, fit in vibration.decay_by_window(*ring_down(trial, 3.0))
        ],
    }


def _repeat(a: BeamTrial, b: BeamTrial) -> dict[str, Any]:
    floor = vibration.repeat_floor(a.after_release(), b.after_release(), until_s=COMPARE_S)
    return {
        "pair": [a.name, b.name],
        "window_s": [0.0, float(floor.time_s[-1])],
        "rms_xyz_m": floor.rms,
        "rms_m": floor.total_rms,
        "vertical_rms_m": floor.rms[2],
        "vertical_rms_best_lag_m": floor.rms_best[2],
        "best_lag_s": floor.lag_s,
        "peak_xyz_m": floor.peak,
    }


def moving_tip_mass(light_Hz: float, loaded_Hz: float, added_kg: float) -> float:
    """Modal mass at the tip that an added mass and the two frequencies imply [kg].

    f^2 = k / m and f_loaded^2 = k / (m + added)  =>  m = added / ((f / f_loaded)^2 - 1).
    A cantilever has a quarter of its own mass there; a weight that acted as a constant force
    would leave the frequency alone and make this infinite.
    """
    ratio = (light_Hz / loaded_Hz) ** 2 - 1.0
    return added_kg / ratio if ratio > 0 else float("inf")
