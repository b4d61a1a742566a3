"""Pneumatic fish tail in air, one pressure step: one recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffsim.data.importers.common import facts, read_columns, read_metadata, switched
from diffsim.data.study import Channel, Run, Study

COLUMNS = tuple(f"tail_{axis}_m" for axis in "xyz")
STEP_FRAME = 2  # "at about frame 2" (README)
REPEAT_SD = 1e-4  # [m] see below


def import_fish_tail(folder: Path) -> Study:
    """The tail's marker as recorded; the pressure is unknown, the command is its share of the step.

    The clamped markers wander by 8 um rms and are left out. The tracker's noise is 4 um, but there
    is no repeat: 0.1 mm, 0.5 % of the motion, is an assumption of what one would differ by.
    """
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
    return Study(
        name="fish_tail",
        system="soft_body",
        channels=tuple(Channel(c, "m", "position", REPEAT_SD) for c in COLUMNS),
        runs=(run,),
        metadata=facts(
            meta,
            held_out="none: there is one recording; nothing can be left out",
            notes="noise is assumed, 0.1 mm: 0.5 % of the motion; no trial was repeated",
        ),
    )
