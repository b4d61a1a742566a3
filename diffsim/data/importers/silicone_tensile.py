"""Pull tests of casting silicones, one specimen of each of five materials, each cut in two parts.

A law of stress is wrong over a stretch of strain, not sample by sample: the samples of a pull are
averaged in bins, and the law is held to 1 % in each beside the noise of the load cell.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffsim.data.importers.common import facts, read_columns, read_metadata, scaled
from diffsim.data.study import Channel, Run, Study

STRESS_SD_PA = 200.0  # README
LAW_SHARE = 0.01  # of the stress, to which a law is held
NUM_BINS = 36
FITTED_SHARE = 2.0 / 3.0  # of the greatest strain; what lies above is held out, and
HOLD_OUT_EVERY = 4  # bin below


def import_silicone_tensile(folder: Path) -> Study:
    """Engineering stress against the engineering strain that the machine imposed."""
    meta = read_metadata(folder)
    runs = []
    for order, entry in enumerate(meta["files"]):
        data, _ = read_columns(
            folder / entry["file"], ["time_s", "engineering_strain", "engineering_stress_Pa"]
        )
        name = Path(entry["file"]).stem
        # narrow bins first: the stress bends most where the pull begins
        share = data["engineering_strain"] / data["engineering_strain"][-1]
        _, label = np.unique(np.floor(NUM_BINS * share ** (2.0 / 3.0)), return_inverse=True)
        count = np.bincount(label)
        time, strain, stress = (np.bincount(label, column) / count for column in data.values())
        fitted = strain <= FITTED_SHARE * strain[-1]
        fitted[HOLD_OUT_EVERY - 1 :: HOLD_OUT_EVERY] = False
        for use, rows in (("fit", fitted), ("test", ~fitted)):
            runs.append(
                Run(
                    name=f"{name}_{use}",
                    time_s=time[rows],
                    measured=scaled(stress[rows, None], STRESS_SD_PA, LAW_SHARE),
                    command={"engineering_strain": strain[rows]},
                    group=f"{name}_{use}",
                    order=order,
                    use=use,
                    setup={
                        "gauge_length_m": float(meta["specimen"]["gauge_length_m"]),
                        "area_m2": float(meta["specimen"]["area_m2"]),
                        "speed_m_s": float(meta["test"]["speed_m_s"]),
                    },
                )
            )
    return Study(
        name="silicone_tensile",
        system="soft_body",
        channels=(Channel("scaled_stress", "-", "stress", 1.0),),
        runs=tuple(runs),
        metadata=facts(
            meta,
            held_out="of every pull the upper third of the strain and each fourth bin below: every "
            "trial is another material, one specimen each, so none tells of another; a law that is "
            "right carries on, and is right in between",
            notes="one Young's modulus per material; strain from the crosshead, slip included",
        )
        | {"specimen": meta["specimen"], "test": meta["test"]},
    )
