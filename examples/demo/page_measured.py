"""The measured half of the demo's page: what the recordings say, in figures and tables."""

from __future__ import annotations

from typing import Any

import numpy as np

from diffsim.viz.report import Section, Table
from examples.data import vibration
from examples.data.beam import BeamStudy, BeamTrial
from examples.data.beam_motion import COMPARE_S, moving_tip_mass, ring_down
from examples.demo import panels

ROLES = ("measured", "measured_2", "third", "fourth")
CASE_TITLES = {"gravity": "own weight only", "load52": "52 g weight at the tip"}


def case_title(case: str) -> str:
    """A case in words."""
    return CASE_TITLES.get(case, case)


def section(study: BeamStudy, numbers: dict[str, Any]) -> Section:
    """Trajectories, spectra, decay, repeat differences, and the table of numbers."""
    cases = study.repeats()
    return Section(
        title="What was measured",
        text=[_masses(numbers, study), _creep(numbers)],
        content=[
            panels.picture(
                lambda narrow: panels.trajectories(
                    [(case_title(c), _tip_curves(ts)) for c, ts in cases.items()],
                    ylabel="tip height [mm]",
                    narrow=narrow,
                ),
                "Vertical displacement of the tip from its held place, mean of three markers, "
                "both repeats of each case aligned at release.",
            ),
            panels.picture(
                lambda narrow: panels.spectra(
                    [(case_title(c), _spectrum_curves(ts)) for c, ts in cases.items()],
                    max_Hz=40.0,
                    floor_m=1e-7,
                    narrow=narrow,
                ),
                "Amplitude spectra of the first four seconds: vertical (solid) and lateral "
                "(dashed). With the weight, the vertical swing slows down and the lateral one "
                "does not.",
            ),
            panels.picture(
                lambda narrow: panels.decay_envelopes(
                    [(case_title(c), _decay_curves(ts)) for c, ts in cases.items()], narrow=narrow
                ),
                "Height of successive swings. A straight line is a constant damping ratio.",
            ),
            panels.picture(
                lambda narrow: panels.residuals(
                    [(case_title(c), _difference(ts), None) for c, ts in cases.items()],
                    ylabel="a minus b [mm]",
                    narrow=narrow,
                ),
                "The floor: difference of the two repeats, aligned at release. No simulation "
                "can be told right or wrong below it.",
            ),
            _table(study, numbers),
        ],
    )


def _tip_curves(trials: tuple[BeamTrial, ...]) -> list[panels.Curve]:
    curves = []
    for role, trial in zip(ROLES, trials, strict=False):
        shown = (trial.time_s > -0.1) & (trial.time_s < COMPARE_S)
        z = trial.tip_displacement_m[shown, 2]
        curves.append(panels.Curve(x=trial.time_s[shown], y=z, label=trial.name, role=role))
    return curves


def _spectrum_curves(trials: tuple[BeamTrial, ...]) -> list[panels.Curve]:
    curves = []
    for role, trial in zip(ROLES, trials, strict=False):
        time_s, tip = trial.after_release(4.0)
        for axis, label, dashed in ((2, "vertical", False), (1, "lateral", True)):
            f, amplitude = vibration.amplitude_spectrum(time_s, tip[:, axis])
            curves.append(
                panels.Curve(
                    x=f, y=amplitude, label=f"{trial.name} {label}", role=role, dashed=dashed
                )
            )
    return curves


def _decay_curves(trials: tuple[BeamTrial, ...]) -> list[panels.Curve]:
    curves = []
    for role, trial in zip(ROLES, trials, strict=False):
        turns = vibration.swings(*ring_down(trial, 4.0), smallest=0.005)
        curves.append(
            panels.Curve(
                x=turns.time_s[:-1], y=turns.height, label=trial.name, role=role, points=True
            )
        )
    return curves


def _difference(trials: tuple[BeamTrial, ...]) -> list[panels.Curve]:
    floor = vibration.repeat_floor(
        trials[0].after_release(), trials[1].after_release(), until_s=COMPARE_S
    )
    labels = (("third", "along"), ("fourth", "lateral"), ("fitted", "vertical"))
    return [
        panels.Curve(x=floor.time_s, y=floor.difference[:, axis], label=label, role=role)
        for axis, (role, label) in enumerate(labels)
    ]


def _mean(numbers: dict[str, Any], case: str, key: str) -> float:
    return float(np.mean([n[key] for n in numbers["trials"].values() if n["case"] == case]))


def _masses(numbers: dict[str, Any], study: BeamStudy) -> str:
    loaded = [t for t in study.trials if t.tip_load_mass_kg > 0]
    light = [t for t in study.trials if t.tip_load_mass_kg == 0]
    if not loaded or not light:
        return ""
    slow = _mean(numbers, loaded[0].case, "frequency_Hz")
    fast = _mean(numbers, light[0].case, "frequency_Hz")
    mass = moving_tip_mass(fast, slow, loaded[0].tip_load_mass_kg)
    return (
        f"The weight slows the beam from {fast:.2f} to {slow:.2f} Hz. A constant force could not "
        f"do that: the weight is a mass that moves with the tip. The two frequencies imply a "
        f"modal mass of {1e3 * mass:.1f} g for the bare tip; a quarter of the bar is "
        f"{250 * study.geometry.mass_kg:.1f} g."
    )


def _creep(numbers: dict[str, Any]) -> str:
    shares = [n["creep_share_per_decade"] for n in numbers["trials"].values()]
    early = [1 + n["level_after_0.1s_m"] / n["static_sag_m"] for n in numbers["trials"].values()]
    return (
        f"The rubber creeps: its sag grows by {100 * min(shares):.1f} to {100 * max(shares):.1f} % "
        f"per tenfold time, and the level about which the tip first swings lies "
        f"{100 * np.mean(early):.0f} % above the one it settles at. "
        "No elastic material has both."
    )


def _table(study: BeamStudy, numbers: dict[str, Any]) -> Table:
    rows = []
    for name, n in numbers["trials"].items():
        repeat = numbers["repeats"].get(n["case"])
        windows = n["by_amplitude"]
        rows.append(
            [
                name,
                f"{1e3 * n['static_sag_m']:.2f}",
                f"{100 * n['creep_share_per_decade']:.1f}",
                f"{n['frequency_Hz']:.2f}",
                f"{n['damping_ratio']:.4f}",
                f"{windows[0]['damping_ratio']:.3f} → {windows[-1]['damping_ratio']:.3f}",
                f"{n['tip_rotation_deg'][1]:.1f}",
                f"{1e3 * n['lateral_peak_m']:.2f}",
                f"{1e3 * repeat['vertical_rms_m']:.2f}" if repeat else "no repeat",
                f"{1e3 * repeat['vertical_rms_best_lag_m']:.2f}" if repeat else "no repeat",
            ]
        )
    return Table(
        columns=[
            "trial",
            "sag [mm]",
            "creep [%/decade]",
            "f [Hz]",
            "damping ratio",
            "…from first to last swings",
            "tip turn [°]",
            "lateral peak [mm]",
            "repeat floor [mm]",
            "…best lag [mm]",
        ],
        rows=rows,
        caption=f"Vertical motion, first {COMPARE_S:g} s. Floor: root mean square difference of "
        "the two repeats, aligned at release, and with the shift that makes it least.",
    )
