"""The demo's last stage: what the described beam gets wrong, named, added, and the gain measured.

A quick look at the published study, with few candidates. ``docs/measured/silicone_beam.md`` has the
diagnosis with all of them.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from diffsim.core.files import to_plain
from diffsim.diagnose import Report, diagnose
from diffsim.systems import setup_of
from examples.data.beam import BeamStudy
from examples.demo.plan import Plan
from examples.demo.published import write_study

SKIPPED = (
    "These recordings were computed by the virtual laboratory: a cause found in them would say "
    "nothing of a real beam. The diagnosis runs on the measured ones (DIFFSIM_DATA)."
)

NOT_RUN = "The diagnosis of these recordings was switched off: Plan(diagnosis_effects=...) runs it."


def why_skipped(study: BeamStudy, plan: Plan) -> str | None:
    """Why there is no diagnosis of these recordings; None: there is one."""
    if study.is_virtual:
        return SKIPPED
    return None if plan.diagnosis_effects else NOT_RUN


def describe(
    study: BeamStudy,
    plan: Plan,
    out: Path,
    tell: Callable[[str, float], None] = lambda doing, share: None,
) -> dict[str, Any]:
    """Diagnose the recordings; finished figures and tables, so that the page can be made again.

    Args:
        study: Measured recordings; of virtual ones only why they are skipped is said.
        plan: Its candidate causes.
        out: Folder for ``study.yaml``, the study that is diagnosed.
        tell: Receives what is being done, and which share of all is done.
    """
    if (why := why_skipped(study, plan)) is not None:
        return {"skipped": why}
    began = time.process_time()
    described = write_study(study.folder, out)
    given = setup_of(described)
    effects = [e for e in given.effects if e.name in plan.diagnosis_effects]
    found = diagnose(
        described,
        given.model,
        effects,
        seed=0,
        unknowns=given.unknowns,
        settings=given.settings,
        progress=lambda stage, fraction, doing: tell(f"{stage}, {doing}", fraction),
    )
    return {
        "verdict": found.verdict,
        "sentences": list(found.sentences),
        "named": list(found.named),
        "gain": None if found.gain is None else to_plain(asdict(found.gain)),
        "num_candidates": len(effects),
        "table": _table(found),
        "gates": [to_plain(asdict(gate)) for gate in found.gates],
        "noise": to_plain(found.noise),
        "charts": _charts(found),
        "cpu_s": time.process_time() - began,
    }


def _table(found: Report) -> list[list[str]]:
    """Rows of the page: effect, status, size, nats, held-out gain, aliases."""
    rows = []
    for row in found.table:
        unit = "" if row.unit == "-" else f" {row.unit}"
        sizes = [f"{v:.3g} ± {1.645 * row.sd[c]:.2g}{unit}" for c, v in row.size.items()]
        gain = row.gain
        rows.append(
            [
                row.effect,
                f"{row.status}, {row.note}" if row.note else row.status,
                "; ".join(sizes),
                "–" if row.nats is None else f"{row.nats:.1f}",
                "–" if gain is None else f"{gain.value:.2f} ({gain.low:.2f} to {gain.high:.2f})",
                ", ".join(row.aliases),
            ]
        )
    return rows


def _charts(found: Report) -> list[dict[str, Any]]:
    """Before and after on the run that no fit has seen, residuals, and what mimics what."""
    from diffsim.viz import diagnosis_charts as draw
    from diffsim.viz.diagnosis_series import predicted_runs, with_noise

    channels = with_noise(found.study.channels, found.noise["sd"])
    runs = predicted_runs(found.study, found.null, found.best if found.named else None)
    held_out = [run for run in runs if run.use == "test"]
    drawn = [
        (
            draw.runs_over_time(held_out, channels),
            "The run that no fit has seen. Dots: measured; dashed: the fitted model before; line: "
            "the extended model. Its own start was fitted to it, for both alike. Drag to zoom.",
        ),
        (
            draw.residual_views(runs, channels),
            "What is left, in standard deviations of the noise; grey: 95 % of noise alone.",
        ),
        (
            draw.confounding_matrix(found.confounding_names, found.confounding),
            "Cosines between what the causes do to the record, after refitting everything else: "
            "near ±1 these recordings cannot part them.",
        ),
    ]
    return [{"figure": json.loads(figure.to_json()), "caption": text} for figure, text in drawn]
