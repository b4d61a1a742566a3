"""Three causes of the disagreement, each shown on its own: time step, weight, mesh."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from diffsim.viz.figures import COLORS, INK, SOFT
from diffsim.viz.report import Section, Table
from examples.data.beam import BeamStudy
from examples.data.beam_motion import COMPARE_S, moving_tip_mass
from examples.demo import panels, verdict
from examples.demo.numerics import euler_damping_ratio

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INTEGRATOR_NAMES = {
    "implicit_euler": "implicit Euler",
    "bdf2": "BDF2",
    "implicit_midpoint": "implicit midpoint",
}
_COLORS = {"implicit_euler": "published", "bdf2": "fourth", "implicit_midpoint": "fitted"}
_SHOWN_AS_ZERO = 2e-4


def damping(study: BeamStudy, results: dict[str, Any]) -> Section:
    """Damping ratio of an undamped beam against the time step."""
    light, _ = verdict.cases(study)
    measured = verdict.mean(results, light, "damping_ratio")
    rows = results["numerics"]["rows"]
    omega = 2 * np.pi * verdict.mean(results, light, "frequency_Hz")
    return Section(
        title="The time step damps more than the rubber",
        text=[
            "The same beam without any material damping. Whatever rings down here is the "
            "integrator. Implicit Euler's share falls only in proportion to the step: to keep it "
            f"below a tenth of the measured {measured:.3f} takes steps of "
            f"{1e3 * 0.2 * measured / omega:.2f} ms.",
        ],
        content=[
            panels.picture(
                lambda narrow: _numerical_damping(rows, omega, measured, narrow),
                caption="Numerical damping against the time step. Points at the lower edge: "
                f"{_SHOWN_AS_ZERO:g} or less.",
            ),
            Table(
                columns=["integrator", "step [ms]", "damping ratio", "…/ measured", "f [Hz]"],
                rows=[
                    [
                        INTEGRATOR_NAMES[r["integrator"]],
                        f"{1e3 * r['dt_s']:g}",
                        f"{abs(r['damping_ratio']):.4f}",
                        f"{abs(r['damping_ratio']) / measured:.2f}",
                        f"{r['frequency_Hz']:.3f}",
                    ]
                    for r in rows
                ],
                caption="No material damping; E from the static sag. The step also slows the "
                "beam down.",
            ),
        ],
    )


def _numerical_damping(
    rows: Sequence[dict[str, Any]], omega: float, measured: float, narrow: bool
) -> Figure:
    figure, ax = panels.one_panel(narrow, width=7.2, height=3.3)
    steps = np.geomspace(min(r["dt_s"] for r in rows) / 1.3, max(r["dt_s"] for r in rows) * 1.3)
    ax.plot(1e3 * steps, [euler_damping_ratio(omega, h) for h in steps], color=SOFT, lw=0.8,
            ls=":", label="implicit Euler, theory")  # fmt: skip
    for name, words in INTEGRATOR_NAMES.items():
        mine = [r for r in rows if r["integrator"] == name]
        ax.plot(
            [1e3 * r["dt_s"] for r in mine],
            [max(abs(r["damping_ratio"]), _SHOWN_AS_ZERO) for r in mine],
            "o-", ms=5, lw=1.3, color=COLORS[_COLORS[name]], label=words,
        )  # fmt: skip
    ax.axhline(measured, color=INK, lw=1.6, label="measured")
    ax.set(xscale="log", yscale="log", ylim=(_SHOWN_AS_ZERO / 1.5, 0.6))
    ticks = sorted({1e3 * r["dt_s"] for r in rows})
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    ax.minorticks_off()
    ax.yaxis.set_major_formatter("{x:g}")
    ax.set_xlabel("time step [ms]", color=SOFT)
    ax.set_ylabel("damping ratio", color=SOFT)
    panels.legend(ax, narrow, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def weight(study: BeamStudy, results: dict[str, Any]) -> Section:
    """The hanging weight as a force and as a mass, both with the parameters of the light case."""
    light, loaded = verdict.cases(study)
    trial = study.repeats()[loaded][1]
    kg = trial.tip_load_mass_kg
    fast, slow = (verdict.mean(results, case, "frequency_Hz") for case in (light, loaded))
    runs = {name: results["simulated"][name][loaded] for name in ("identified", "mass", "joint")}
    time_s, tip = trial.after_release(COMPARE_S)
    curves = [panels.Curve(x=time_s, y=tip[:, 2], label=trial.name, role="measured")]
    for name, words, role in (
        ("identified", "constant force", "published"),
        ("mass", "mass, nothing refitted", "fitted"),
        ("joint", "mass, damping fitted on both cases", "third"),
    ):
        curves.append(
            panels.Curve(
                x=np.asarray(runs[name]["time_s"]),
                y=np.asarray(runs[name]["tip_m"])[:, 2],
                label=f"{words}: {runs[name]['frequency_Hz']:.1f} Hz",
                role=role,
            )
        )
    left = {name: 1e3 * verdict.left(results, name, trial.name) for name in runs}
    return Section(
        title="The weight is a mass, not a force",
        text=[
            f"Measured: {fast:.2f} Hz without the weight, {slow:.2f} Hz with it. A constant force "
            "moves the level and leaves the frequency alone. Two frequencies and the added "
            f"{1e3 * kg:.0f} g give the modal mass of the bare tip without any simulation: "
            f"m = {1e3 * kg:.0f} g / ((f/f_loaded)² − 1) = "
            f"{1e3 * moving_tip_mass(fast, slow, kg):.1f} g; a quarter of the bar, the textbook "
            f"value, is {250 * study.geometry.mass_kg:.1f} g.",
            f"On {trial.name}: {left['identified']:.2f} mm as a force, {left['mass']:.2f} mm as a "
            f"mass with nothing refitted, {left['joint']:.2f} mm with damping fitted on both "
            f"cases; the floor is {1e3 * verdict.floor(results, loaded):.2f} mm.",
            _unexplained(study, results, loaded),
        ],
        content=[
            panels.picture(
                lambda narrow: panels.trajectories(
                    [(f"{trial.name}, weight of {1e3 * kg:.0f} g", curves)],
                    ylabel="tip height [mm]",
                    narrow=narrow,
                ),
                caption="The loaded beam, E and damping identified without the weight.",
            )
        ],
    )


def _unexplained(study: BeamStudy, results: dict[str, Any], loaded: str) -> str:
    """What the last model still gets wrong with the weight, in numbers."""
    run = results["simulated"]["joint"][loaded]
    trials = study.repeats()[loaded]
    shifts = [results["remaining"]["joint"][trial.name]["best_shift_s"] for trial in trials]
    off = run["damping_ratio"] / verdict.mean(results, loaded, "damping_ratio")
    caution = "so do not take it for the rubber's; " if abs(off - 1.0) > 0.2 else ""
    return (
        f"Left over: the model settles at {1e3 * run['static_sag_m']:.1f} mm, the tip at "
        f"{1e3 * verdict.mean(results, loaded, 'static_sag_m'):.1f} mm (creep, at least in "
        f"part); the fitted damping ratio is {run['damping_ratio']:.3f} where the ring-down has "
        f"{verdict.mean(results, loaded, 'damping_ratio'):.3f}, {caution}and the model "
        f"would have to be released {1e3 * min(shifts):.0f} to {1e3 * max(shifts):.0f} ms late "
        "(limit 10 ms) to fit best. A string that goes slack at "
        "release, or friction where the weight hangs, would do such things; neither is tested "
        "here."
    )


def mesh(study: BeamStudy, results: dict[str, Any]) -> Section:
    """Static sag against mesh and Poisson ratio."""
    study_of = results["mesh"]
    light, _ = verdict.cases(study)
    measured = verdict.mean(results, light, "static_sag_m")
    rows = study_of["rows"]
    ratios = list(dict.fromkeys(r["poissons_ratio"] for r in rows))
    e = study_of["youngs_modulus_Pa"]
    published = [r for r in rows if r["poissons_ratio"] == max(ratios)]
    own = study_of["timoshenko_sag_m"] / study_of["factor_beam_theory"]
    cells = " x ".join(map(str, study_of["cells"]))
    fine = " x ".join(map(str, study_of["finest_cells"]))
    return Section(
        title="How stiff the mesh is",
        text=[
            f"With the published E = {e / 1e3:.0f} kPa and ν = {max(ratios):g}, trilinear "
            f"elements lock: the sag is {1e3 * published[0]['sag_m']:.2f} mm on the coarsest and "
            f"{1e3 * published[-1]['sag_m']:.2f} mm on the finest mesh tried, where beam theory "
            f"has {1e3 * study_of['timoshenko_sag_published_nu_m']:.2f} mm. A modulus fitted on "
            "such a mesh is a number of the mesh.",
            f"The demo therefore uses ν = {study_of['poissons_ratio']:g} on {cells} elements "
            f"({1e3 * own:.2f} mm): bending hardly depends on ν, and the finest mesh ({fine}) "
            f"sags {100 * (study_of['factor_finest'] - 1):.0f} % more. Multiply E identified here "
            f"by {study_of['factor_finest']:.3f} to use it on the finest mesh, or by "
            f"{study_of['factor_beam_theory']:.3f} in beam theory, whose clamped section is free "
            "to contract sideways and so softer than a clamped solid.",
        ],
        content=[
            panels.picture(
                lambda narrow: _sag_over_size(study_of, measured, narrow),
                caption=f"Sag under own weight at E = {e / 1e3:.0f} kPa, fully integrated "
                "trilinear hexahedra.",
            )
        ],
    )


def _sag_over_size(study_of: dict[str, Any], measured: float, narrow: bool) -> Figure:
    rows = study_of["rows"]
    ratios = list(dict.fromkeys(r["poissons_ratio"] for r in rows))
    figure, ax = panels.one_panel(narrow, width=7.2, height=3.3)
    for nu, role in zip(ratios, ("published", "fourth", "fitted"), strict=False):
        mine = [r for r in rows if r["poissons_ratio"] == nu]
        ax.plot([r["num_dofs"] for r in mine], [1e3 * r["sag_m"] for r in mine], "o-", ms=4, lw=1.3,
                color=COLORS[role], label=f"ν = {nu:g}")  # fmt: skip
    ax.axhline(1e3 * study_of["timoshenko_sag_m"], color=SOFT, lw=1.0, ls="--",
               label="Timoshenko beam")  # fmt: skip
    ax.axhline(1e3 * measured, color=INK, lw=1.6, label="measured")
    ax.set(xscale="log", ylim=(0, None))
    ax.xaxis.set_major_formatter("{x:,.0f}")
    ax.xaxis.set_minor_formatter("")
    ax.set_xlabel("degrees of freedom", color=SOFT)
    ax.set_ylabel("static sag [mm]", color=SOFT)
    panels.legend(ax, narrow, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
