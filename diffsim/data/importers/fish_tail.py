"""Pneumatic fish tail in air, one pressure step: one recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffsim.data.importers.common import facts, read_columns, read_metadata, switched
from diffsim.data.study import Channel, Run, Study

COLUMNS = tuple(f"{m}_{axis}_m" for m in ("tail", "base1", "base2", "base3") for axis in "xyz")
STEP_FRAME = 2  # "at about frame 2" (README)


def import_fish_tail(folder: Path) -> Study:
    """Marker places as recorded; the pressure is unknown, the command is its share of the step."""
    meta = read_metadata(folder)
    data, _ = read_columns(folder / "step.csv", ["time_s", *COLUMNS])
    run = Run(
        name="step",
        time_s=data["time_s"],
        measured=np.column_stack([data[c] for c in COLUMNS]),
        command={"pressure_share": switched(len(data["time_s"]), STEP_FRAME, None, 1.0)},
        group="step",
        setup={"step_frame": float(STEP_FRAME)},
    )
    sd = float(meta["noise"]["high_frequency_std_m"])
    return Study(
        name="fish_tail",
        system="soft_body",
        channels=tuple(Channel(c, "m", "position", sd) for c in COLUMNS),
        runs=(run,),
        metadata=facts(meta, held_out="none: there is one recording; nothing can be left out"),
    )
