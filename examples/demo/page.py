"""The demo's page: verdict and key figures, then the sections in the order of the argument."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from diffsim.viz import figures
from diffsim.viz import report as rp
from examples.data.beam import BeamStudy
from examples.demo import (
    page_causes,
    page_diagnosis,
    page_ladder,
    page_measured,
    page_moving,
    verdict,
)
from examples.demo.ladder import Rung
from examples.demo.plan import Plan


def report(
    study: BeamStudy,
    results: dict[str, Any],
    models: Sequence[Rung],
    plan: Plan,
    banner: str | None,
    pictures: tuple[bytes, bytes],
) -> rp.Report:
    """Everything on the page; ``pictures`` are PNG of the beam, for a wide screen and a phone."""
    wide, narrow = (figures.uri_of(content, "png") for content in pictures)
    kind = "virtual" if study.is_virtual else "measured"
    return rp.Report(
        title=f"Silicone beam: simulated against {kind}",
        subtitle="A clamped bar of 100 x 30 x 30 mm, held straight, released; without and with a "
        f"weight at its tip; {len(study.trials)} recordings, compared over 2 s.",
        verdict=results["opening"],
        banner=banner,
        opening=[
            rp.Picture(
                uri=wide,
                narrow=narrow,
                caption="The tip after release: measured, simulated as is usual, and identified.",
            )
        ],
        numbers=_numbers(study, results),
        sections=[
            rp.Section(
                title="In numbers",
                text=[*results["verdict"], *results["hidden"], *results["stored"]],
            ),
            page_ladder.section(study, results, models),
            *page_moving.section(study, results, models),
            page_causes.damping(study, results),
            page_causes.weight(study, results),
            page_causes.mesh(study, results),
            page_ladder.identification(study, results),
            page_measured.section(study, results["measured"]),
            page_diagnosis.section(results["diagnosis"]),
        ],
        held_fixed=_held_fixed(study, plan),
    )


def _numbers(study: BeamStudy, results: dict[str, Any]) -> list[rp.Number]:
    light, loaded = verdict.cases(study)
    numbers = []
    for case, words, model in (
        (light, "own weight", "identified"),
        (loaded, "52 g weight" if not study.is_virtual else "weight", "joint"),
    ):
        trial = verdict.judged(study, case)
        before = verdict.left(results, "published", trial) / verdict.floor(results, case)
        after = verdict.left(results, model, trial) / verdict.floor(results, case)
        numbers.append(
            rp.Number(
                label=f"Error on {trial} ({words}), in units of the repeat floor",
                value=f"{before:.1f} → {after:.1f}",
                unit="× floor",
                note=f"published → identified; floor {1e3 * verdict.floor(results, case):.2f} mm",
                tone="fair" if after < 2 else "bad",
            )
        )
    damping = results["simulated"]["published"][light]["damping_ratio"]
    real = verdict.mean(results, light, "damping_ratio")
    e = results["youngs_modulus"]
    return [
        *numbers,
        rp.Number(
            label="Damping ratio: implicit Euler, 10 ms, no material damping",
            value=f"{damping:.2f}",
            note=f"measured {real:.3f}: {damping / real:.1f} times too much, all numerical",
            tone="bad",
        ),
        rp.Number(
            label="Young's modulus from the motion",
            value=f"{e['motion_on_finest_mesh_Pa'] / 1e3:.0f}",
            unit="kPa",
            note=f"finest mesh; {e['motion_on_this_mesh_Pa'] / 1e3:.0f} on the mesh used, "
            f"{e['motion_by_beam_theory_Pa'] / 1e3:.0f} by beam theory, published "
            f"{e['published_Pa'] / 1e3:.0f}",
        ),
    ]


def _held_fixed(study: BeamStudy, plan: Plan) -> list[tuple[str, str]]:
    bar = study.geometry
    cells = " x ".join(str(n) for n in plan.cells)
    return [
        ("bar", f"{1e3 * bar.length_m:g} x {1e3 * bar.width_m:g} x {1e3 * bar.height_m:g} mm"),
        ("density", f"{bar.density_kg_m3:g} kg/m³"),
        (
            "Poisson ratio",
            f"{plan.poissons_ratio:g} (published {bar.poissons_ratio:g}, which locks)",
        ),
        ("gravity", f"{bar.gravity_m_s2:g} m/s² along the model's −z; inclination not fitted"),
        ("mesh", f"{cells} trilinear hexahedra"),
        ("clamp", "rigid; its markers' motion is not removed"),
        ("start", "straight and unstrained, as published; the real tip is propped by a hand"),
        ("weight", "on the upper edge of the tip face; no string, no slack"),
        ("release", "one camera frame of shift allowed in fits; headline errors without"),
        ("steps solved to", "1e-5 of the force"),
    ]
