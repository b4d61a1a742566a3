"""Pull tests of casting silicones, one specimen of each of five materials."""

from __future__ import annotations

from pathlib import Path

from diffsim.data.importers.common import facts, read_columns, read_metadata
from diffsim.data.study import Channel, Run, Study

STRESS_SD_PA = 200.0  # README


def import_silicone_tensile(folder: Path) -> Study:
    """Engineering stress against the engineering strain that the machine imposed."""
    meta = read_metadata(folder)
    runs = []
    for order, entry in enumerate(meta["files"]):
        data, _ = read_columns(
            folder / entry["file"], ["time_s", "engineering_strain", "engineering_stress_Pa"]
        )
        name = Path(entry["file"]).stem
        runs.append(
            Run(
                name=name,
                time_s=data["time_s"],
                measured=data["engineering_stress_Pa"][:, None],
                command={"engineering_strain": data["engineering_strain"]},
                group=name,
                order=order,
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
        channels=(Channel("engineering_stress_Pa", "Pa", "stress", STRESS_SD_PA),),
        runs=tuple(runs),
        metadata=facts(
            meta,
            held_out="none: every trial is another material, one specimen each; leaving one out "
            "would test nothing about the others",
            notes="one parameter set per run; strain from the crosshead, slip included",
        )
        | {"specimen": meta["specimen"], "test": meta["test"]},
    )
