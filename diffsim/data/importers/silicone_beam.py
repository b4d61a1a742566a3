"""Clamped silicone beam, held straight and let go, with and without a hanging weight."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffsim.data.beam import TIP_MARKERS, load_beam_study
from diffsim.data.importers.common import facts, read_metadata
from diffsim.data.study import Channel, Run, Study


def import_silicone_beam(folder: Path) -> Study:
    """Displacements of the tip markers from the held state, in the model frame, since release."""
    beam, meta = load_beam_study(folder), read_metadata(folder)
    runs = []
    for order, trial in enumerate(beam.trials):
        command = {"released": np.where(trial.time_s >= 0.0, 1.0, 0.0)}
        if np.isfinite(trial.support_displacement_m).all():
            command["support_x_m"] = trial.support_displacement_m[:, 0]
            command["support_z_m"] = trial.support_displacement_m[:, 2]
        runs.append(
            Run(
                name=trial.name,
                time_s=trial.time_s,
                measured=trial.marker_displacement_m.reshape(len(trial.time_s), -1),
                command=command,
                group=trial.case,
                order=order,
                use="test" if trial.name == "load52_b" else "fit",
                setup={
                    "tip_load_N": trial.tip_load_N,
                    "tip_load_mass_kg": trial.tip_load_mass_kg,
                    "release_s": 0.0,
                },
            )
        )
    sd = meta.get("noise", {}).get("high_frequency_std_m_worst_marker", 1.0e-5)
    markers = beam.trials[0].markers or TIP_MARKERS
    return Study(
        name="silicone_beam",
        system="soft_body",
        channels=tuple(
            Channel(f"{marker}_{axis}_m", "m", "position", float(sd))
            for marker in markers
            for axis in "xyz"
        ),
        runs=tuple(runs),
        metadata=facts(
            meta,
            held_out="load52_b: second recording of the loaded case; both cases stay in the fit, "
            "so that the held-out run tests the repeatability of the harder one",
            notes="displacements from the held state; the order of the trials is that of the "
            "file names, the source states none; the release is by hand",
        ),
    )
