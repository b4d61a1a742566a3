"""An acrylic cube tossed by hand onto a board, 64 times."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffsim.data.importers.common import facts, jitter, read_columns, read_metadata
from diffsim.data.study import Channel, Run, Study

POSE = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
TWIST = ("vx_m_s", "vy_m_s", "vz_m_s", "wx_rad_s", "wy_rad_s", "wz_rad_s")
HOLD_OUT_EVERY = 8
REST_FRAMES = 10  # at the end of each toss, where the metadata measures its noise, too


def import_cube_toss(folder: Path) -> Study:
    """Poses as tracked; the velocities of the first frame are start values in ``setup``."""
    meta = read_metadata(folder)
    data, text = read_columns(folder / "tosses.csv", ["time_s", *POSE, *TWIST], ["toss"])
    tosses = np.array(text["toss"])
    runs = []
    for order, toss in enumerate(dict.fromkeys(text["toss"])):
        rows = tosses == toss
        runs.append(
            Run(
                name=f"toss_{int(toss):03d}",
                time_s=data["time_s"][rows],
                measured=np.column_stack([data[c][rows] for c in POSE]),
                command={},
                group=f"toss_{int(toss):03d}",
                order=order,
                use="holdout" if order % HOLD_OUT_EVERY == HOLD_OUT_EVERY - 1 else "fit",
                setup={f"start_{c}": float(data[c][rows][0]) for c in TWIST},
            )
        )
    rest = np.array([jitter(run.measured[-REST_FRAMES:]) for run in runs])
    noise = [*meta["noise"]["position_std_at_rest_m"], *np.median(rest[:, 3:], axis=0)]
    kinds = ["position"] * 3 + ["orientation"] * 4
    units = ["m"] * 3 + ["-"] * 4
    # quaternions are written to five decimals: rounding is the least noise they can have
    least = [0.0] * 3 + [1e-5 / np.sqrt(12.0)] * 4
    return Study(
        name="cube_toss",
        system="rigid_body",
        channels=tuple(
            Channel(name, unit, kind, max(float(sd), low))
            for name, unit, kind, sd, low in zip(POSE, units, kinds, noise, least, strict=True)
        ),
        runs=tuple(runs),
        metadata=facts(
            meta,
            held_out=f"every {HOLD_OUT_EVERY}th toss, by number and not by outcome",
            notes="each toss is its own command: the start state, thrown by hand, never repeats; "
            "the start velocities are filtered finite differences",
        )
        | {"authors_model_parameters": meta["authors_model_parameters"]},
    )
