"""The answer in a few sentences, each with its numbers: what a roboticist can act on."""

from __future__ import annotations

from typing import Any

import numpy as np

from examples.data.beam import BeamStudy
from examples.data.beam_motion import moving_tip_mass
from examples.demo.numerics import euler_damping_ratio


def sentences(study: BeamStudy, results: dict[str, Any]) -> list[str]:
    """The verdict."""
    return [
        _published(study, results),
        _numerical_damping(study, results),
        _identified(study, results),
        _weight(study, results),
        _rest(study, results),
    ]


def opening(study: BeamStudy, results: dict[str, Any]) -> list[str]:
    """What was measured, what the simulation got wrong and why, and what is left, for anybody."""
    light, loaded = cases(study)
    bar, trials = study.geometry, [judged(study, case) for case in (light, loaded)]
    weight = study.repeats()[loaded][0].tip_load_mass_kg
    wide = " x ".join(f"{1e3 * side:g}" for side in (bar.length_m, bar.width_m, bar.height_m))
    how = "computed, as virtual data," if study.is_virtual else "filmed"
    before = " and ".join(_mm(left(results, "published", trial)) for trial in trials)
    after = " and ".join(
        _mm(left(results, model, trial))
        for model, trial in zip(("identified", "joint"), trials, strict=True)
    )
    apart = " and ".join(_mm(floor(results, case)) for case in (light, loaded))
    return [
        f"A silicone bar of {wide} mm, clamped at one end, is let go: its swing was {how} without "
        f"and with {1e3 * weight:.0f} g at the tip, twice each.",
        f"Simulated as is usual, the tip is off by {before} mm: large time steps brake the swing, "
        "not the rubber, and the weight pulls down but has no mass.",
        "With small steps, a weight that has mass, and stiffness and damping found by gradients, "
        f"{after} mm are left; two recordings of the same differ by {apart} mm.",
    ]


def hidden(study: BeamStudy, results: dict[str, Any]) -> list[str]:
    """What a virtual laboratory hid, beside what was found; nothing of a real beam.

    Its foam relaxes, so that it is stiffer in motion than at rest: at a frequency w a part that
    relaxes within tau carries (w tau)^2 / (1 + (w tau)^2) of its load, as of Maxwell's element.
    """
    truth = results["virtual_truth"]
    if not study.is_virtual or truth is None:
        return []
    swing = 2 * np.pi * mean(results, cases(study)[0], "frequency_Hz")
    turns = (swing * np.array(truth["relaxation_times"])) ** 2
    moving = truth["youngs_modulus"] * (
        1.0 + truth["relaxing_share"] * float(np.mean(turns / (1.0 + turns)))
    )
    return [
        f"Hidden in the laboratory: E = {truth['youngs_modulus'] / 1e3:.0f} kPa at rest, "
        f"{moving / 1e3:.0f} kPa in its swing. Found from the swing: "
        f"{results['youngs_modulus']['motion_by_beam_theory_Pa'] / 1e3:.0f} kPa by beam theory."
    ]


def cases(study: BeamStudy) -> tuple[str, str]:
    """Names of the cases without and with the weight."""
    light, loaded = sorted(study.repeats().values(), key=lambda t: t[0].tip_load_mass_kg)
    return light[0].case, loaded[0].case


def judged(study: BeamStudy, case: str) -> str:
    """The trial of a case that no fit has seen."""
    return study.repeats()[case][1].name


def mean(results: dict[str, Any], case: str, key: str) -> float:
    """Mean of a measured number over the trials of a case."""
    trials = results["measured"]["trials"].values()
    return float(np.mean([n[key] for n in trials if n["case"] == case]))


def left(results: dict[str, Any], model: str, trial: str) -> float:
    """Vertical root mean square error of a model on a trial, aligned at release [m]."""
    return float(results["remaining"][model][trial]["vertical_rms_m"])


def floor(results: dict[str, Any], case: str) -> float:
    """How far the repeats of a case are apart [m]."""
    return float(results["measured"]["repeats"][case]["vertical_rms_m"])


def _mm(value: float) -> str:
    return f"{1e3 * value:.2f}"


def _published(study: BeamStudy, results: dict[str, Any]) -> str:
    light, loaded = cases(study)
    parts = [
        f"{_mm(left(results, 'published', judged(study, case)))} mm {words} (repeats differ by "
        f"{_mm(floor(results, case))} mm)"
        for case, words in ((light, "without the weight"), (loaded, "with it"))
    ]
    share = left(results, "published", judged(study, loaded)) / floor(results, loaded)
    return (
        "Published practice (implicit Euler at 10 ms, stiffness from the static sag, the weight "
        f"as a constant force) misses the tip's height by {parts[0]} and {parts[1]}: "
        f"{left(results, 'published', judged(study, light)) / floor(results, light):.1f} and "
        f"{share:.1f} times the floor."
    )


def _numerical_damping(study: BeamStudy, results: dict[str, Any]) -> str:
    light, _ = cases(study)
    run = results["simulated"]["published"][light]
    measured = mean(results, light, "damping_ratio")
    omega = 2 * np.pi * mean(results, light, "frequency_Hz")
    dt = results["models"]["published"]["dt_s"]
    rows = {(r["integrator"], r["dt_s"]): r for r in results["numerics"]["rows"]}
    small = min(step for name, step in rows if name == "implicit_midpoint")
    return (
        f"Most of its damping is the time step, not the rubber: with no material damping at all, "
        f"implicit Euler at {1e3 * dt:g} ms damps the beam with a ratio of "
        f"{run['damping_ratio']:.2f} (rule of thumb ωh/2 = {omega * dt / 2:.2f}, exactly "
        f"{euler_damping_ratio(omega, dt):.2f} at the measured frequency); measured is "
        f"{measured:.3f}. BDF2 at the same step gives "
        f"{rows['bdf2', dt]['damping_ratio']:.3f}, implicit midpoint at {1e3 * small:g} ms "
        f"{abs(rows['implicit_midpoint', small]['damping_ratio']):.4f}. Identify damping "
        "only with an integrator and a step whose own damping is far below the rubber's."
    )


def _identified(study: BeamStudy, results: dict[str, Any]) -> str:
    light, _ = cases(study)
    trial, fit = judged(study, light), results["identified"]
    e = results["youngs_modulus"]
    run = results["simulated"]["identified"][light]
    error = left(results, "identified", trial)
    return (
        f"Identified by gradient on {fit['fitted_on'][0]}: E = "
        f"{e['motion_on_this_mesh_Pa'] / 1e3:.0f} kPa on this mesh "
        f"({e['motion_on_finest_mesh_Pa'] / 1e3:.0f} kPa on the finest mesh tried, "
        f"{e['motion_by_beam_theory_Pa'] / 1e3:.0f} kPa by beam theory; published "
        f"{e['published_Pa'] / 1e3:.0f} kPa) and stiffness-proportional damping "
        f"{1e3 * fit['value']['rayleigh_beta']:.2f} ms. On {trial}, which the fit has not seen, "
        f"{_mm(error)} mm remain, {error / floor(results, light):.1f} times the floor; frequency "
        f"{run['frequency_Hz']:.2f} Hz (measured {mean(results, light, 'frequency_Hz'):.2f}), "
        f"damping ratio {run['damping_ratio']:.3f} "
        f"({mean(results, light, 'damping_ratio'):.3f})."
    )


def _weight(study: BeamStudy, results: dict[str, Any]) -> str:
    light, loaded = cases(study)
    trial = judged(study, loaded)
    weight = study.repeats()[loaded][0].tip_load_mass_kg
    fast, slow = (mean(results, case, "frequency_Hz") for case in (light, loaded))
    off = results["simulated"]["joint"][loaded]["damping_ratio"] / mean(
        results, loaded, "damping_ratio"
    )
    too_much = ": it pays for something else, too" if off > 1.2 else ""
    force, mass, joint = (results["simulated"][m][loaded] for m in ("identified", "mass", "joint"))
    return (
        f"The weight is a mass, not a force. A constant force keeps the simulated beam at "
        f"{force['frequency_Hz']:.2f} Hz, measured are {slow:.2f} Hz; the same "
        f"{1e3 * weight:.0f} g as a mass give {mass['frequency_Hz']:.2f} Hz with nothing "
        f"refitted. (The two measured frequencies alone ask for a modal tip mass of "
        f"{1e3 * moving_tip_mass(fast, slow, weight):.0f} g, a quarter of the bar is "
        f"{250 * study.geometry.mass_kg:.0f} g.) On {trial} the error falls from "
        f"{_mm(left(results, 'identified', trial))} to {_mm(left(results, 'mass', trial))} mm, and "
        f"to {_mm(left(results, 'joint', trial))} mm with damping fitted on both cases "
        f"(then {joint['damping_ratio']:.3f}, ring-down "
        f"{mean(results, loaded, 'damping_ratio'):.3f}{too_much}). "
        f"{left(results, 'joint', trial) / floor(results, loaded):.1f} times the floor remains "
        "unexplained."
    )


def _rest(study: BeamStudy, results: dict[str, Any]) -> str:
    light, _ = cases(study)
    sag = results["simulated"]["identified"][light]["static_sag_m"]
    measured = mean(results, light, "static_sag_m")
    creep = [n["creep_share_per_decade"] for n in results["measured"]["trials"].values()]
    e = results["youngs_modulus"]
    return (
        f"No elastic modulus has both the frequency and the sag: the identified one sags "
        f"{_mm(sag)} mm, measured are {_mm(measured)} mm after creep of "
        f"{100 * min(creep):.1f} to {100 * max(creep):.1f} % per tenfold time "
        f"({100 * (sag / measured - 1):+.0f} %; fitted to the sag, E is "
        f"{e['sag_on_this_mesh_Pa'] / 1e3:.0f} kPa instead of "
        f"{e['motion_on_this_mesh_Pa'] / 1e3:.0f} kPa on the same mesh). Choose the modulus for "
        "the task: settled pose or motion."
    )
