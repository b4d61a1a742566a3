"""Tendon-driven starfish on a rail, in water and in air."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffsim.core.inside import inside
from diffsim.core.yaml_text import read_yaml_file
from diffsim.data.study import Channel, Run, Study
from diffsim.data.study_file import find_dataset
from diffsim.data.table import read_numbers

MARKERS = ("m1", "m2", "m3", "m4")
COMMAND = "tendon_contraction_m"
WATER_KG_M3, AIR_KG_M3 = 1000.0, 1.2
GROUPS = {
    "airtest": "air_sequence",
    "baseline": "water_sequence_1",
    "horizontal_cyclic1": "water_open_close",
    "horizontal_cyclic3": "water_sequence_2",
}
FACTS = ("title", "source", "sampling", "frame", "geometry", "material", "control", "noise")
HELD_OUT = "horizontal_cyclic1"


def import_starfish(data: str | Path | None = None) -> Study:
    """Marker places as tracked; time zero where the command first changes.

    Args:
        data: Folder that holds the data sets; by default as :func:`diffsim.data.find_dataset`.

    Raises:
        FileNotFoundError: the data is not there.
    """
    folder = find_dataset("starfish", data)
    if folder is None:
        raise FileNotFoundError(
            "no folder starfish with measured data; give data= or set DIFFSIM_DATA to the folder "
            "that holds it"
        )
    meta = read_yaml_file(folder / "metadata.yaml")
    columns = [f"{marker}_{axis}_m" for marker in MARKERS for axis in "xz"]
    runs = []
    for order, entry in enumerate(meta["runs"]):
        name = Path(entry["file"]).stem
        data = read_numbers(inside(folder, entry["file"], "file"), ["time_s", COMMAND, *columns])
        runs.append(
            Run(
                name=name,
                time_s=data["time_s"] - float(entry["command_first_change_s"]),
                measured=np.column_stack([data[c] for c in columns]),
                command={COMMAND: _fill_before_first(data[COMMAND])},
                group=GROUPS[name],
                order=order,
                use="test" if name == HELD_OUT else "fit",
                setup={
                    "medium_density_kg_m3": AIR_KG_M3 if name == "airtest" else WATER_KG_M3,
                    "marker_spacing_m2_m3_m": float(entry["marker_spacing_at_rest_m"]["m2_m3"]),
                    "command_first_change_s": float(entry["command_first_change_s"]),
                    "command_last_logged_s": float(entry["command_last_logged_s"]),
                },
            )
        )
    sd = max(float(entry["noise_std_m"]) for entry in meta["runs"])
    return Study(
        name="starfish",
        system="soft_body",
        channels=tuple(Channel(c, "m", "position", sd) for c in columns),
        runs=tuple(runs),
        metadata={
            **{key: meta[key] for key in FACTS if key in meta},
            "held_out_because": f"{HELD_OUT}: the only run in water with another command",
            "notes": "baseline and horizontal_cyclic3 execute one sequence, but are not repeats: "
            "the second falls behind by 0.12 s in 30 s, and at the best lag the logged commands "
            "still differ by 1.2-2 mm rms of 15 mm; the scale of the picture differs between runs: "
            "marker_spacing_m2_m3_m against the nominal 0.0762 m; command and video clock "
            "are offset by up to 0.1 s per run; before the first logged value it is held, "
            "after the last it is missing; the order is that of the metadata",
        },
    )


def _fill_before_first(command: np.ndarray) -> np.ndarray:
    """The command, with what precedes the first logged value set to that value."""
    first = int(np.argmax(np.isfinite(command)))
    return np.where(np.arange(len(command)) < first, command[first], command)
