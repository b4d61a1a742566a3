"""One segment of a pneumatic silicone arm, pressure steps; two campaigns, each a study.

The third campaign of the data set (``segment_300mbar``) is one trial with other markers; it is in
neither.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffsim.data.importers.common import facts, read_columns, read_metadata, switched
from diffsim.data.study import Channel, Run, Study

TIPS = tuple(f"tip{i}_{axis}_m" for i in (1, 2, 3) for axis in "xyz")
SETTLING_S = 0.15  # the tracker is settling (README)


def import_arm_step(folder: Path) -> Study:
    """Campaign ``step``: pressure on for 3-6 s and off again."""
    return _campaign(
        folder,
        "step",
        held_out="step_250mbar",
        because="step_250mbar: a level between the fitted ones, so that the test is not an "
        "extrapolation",
    )


def import_arm_p25(folder: Path) -> Study:
    """Campaign ``p25``: the first 1.5 s after the step; samples that repeat the last are gaps."""
    return _campaign(
        folder,
        "p25",
        held_out="p25_225mbar",
        because="p25_225mbar: a level between the fitted ones, so that the test is not an "
        "extrapolation",
    )


def _campaign(folder: Path, campaign: str, *, held_out: str, because: str) -> Study:
    meta = read_metadata(folder)
    trials = [entry for entry in meta["trials"] if entry["campaign"] == campaign]
    runs = []
    for order, entry in enumerate(trials):
        name = Path(entry["file"]).stem
        streamed = campaign == "p25"
        extra = ["repeated_sample"] if streamed else []
        data, _ = read_columns(folder / entry["file"], ["time_s", *extra, *TIPS])
        onset, release = entry["motion_onset_frame_detected"], entry["release_frame_detected"]
        places = np.column_stack([data[c] for c in TIPS])
        if streamed:
            places[data["repeated_sample"] == 1.0] = np.nan
        pressure = switched(len(places), onset, release, float(entry["set_pressure_Pa"]))
        keep = data["time_s"] >= (0.0 if streamed else SETTLING_S)
        runs.append(
            Run(
                name=name,
                time_s=(data["time_s"] - data["time_s"][onset])[keep],
                measured=places[keep],
                command={"set_pressure_Pa": pressure[keep]},
                group=name,
                order=order,
                use="holdout" if name == held_out else "fit",
                setup={"set_pressure_Pa": float(entry["set_pressure_Pa"])},
            )
        )
    noise = meta["noise"]["high_frequency_std_m"]
    sd = float(noise["p25"] if campaign == "p25" else noise["tip"])
    return Study(
        name="pneumatic_arm" if campaign == "step" else f"pneumatic_arm_{campaign}",
        system="soft_body",
        channels=tuple(Channel(c, "m", "position", sd) for c in TIPS),
        runs=tuple(runs),
        metadata=facts(
            meta,
            held_out=because,
            notes="places as recorded; the start position moves by up to 0.4 mm between trials; "
            "the command switches where motion was detected, the pressure in the chamber was not "
            "recorded; no level was repeated",
        ),
    )
