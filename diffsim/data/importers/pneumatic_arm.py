"""One segment of a pneumatic silicone arm, pressure steps; two campaigns, each a study.

The third campaign of the data set (``segment_300mbar``) is one trial with other markers; it is in
neither.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffsim.data.importers.common import facts, read_columns, read_metadata, switched
from diffsim.data.study import Channel, Run, Study

TIPS = tuple(f"tip{i}_{axis}_m" for i in (1, 2, 3) for axis in "xyz")
SETTLING_S = 0.15  # the tracker is settling (README)
BEYOND = "step_450mbar"
REST_S = 0.3  # kept before the step
LIVELY_S = 1.0  # after a switch; later nothing but creep happens, which few samples tell
EVERY = 3  # of the lively samples is kept: what a model leaves lasts longer
MODEL_SD = 5e-4  # [m] see ``_campaign``


def import_arm_step(folder: Path, *, beyond: bool = False) -> Study:
    """Campaign ``step``: pressure on for 3-6 s and off again.

    Args:
        folder: Folder of the downloaded data set.
        beyond: Whether 450 mbar is held out, too: an extrapolation, the arm bends 2.5 times as far
            as at 350 mbar, and would outweigh everything else that is held out.
    """
    study = _campaign(
        folder,
        "step",
        held_out=("step_250mbar", BEYOND),
        because="step_250mbar: a level between the fitted ones; step_450mbar is left out "
        "altogether, or held out as an extrapolation",
    )
    if beyond:
        return study
    return replace(study, runs=tuple(run for run in study.runs if run.name != BEYOND))


def import_arm_p25(folder: Path) -> Study:
    """Campaign ``p25``: the first 1.5 s after the step; samples that repeat the last are gaps."""
    return _campaign(
        folder,
        "p25",
        held_out=("p25_225mbar",),
        because="p25_225mbar: a level between the fitted ones, so that the test is not an "
        "extrapolation",
    )


def _campaign(folder: Path, campaign: str, *, held_out: tuple[str, ...], because: str) -> Study:
    meta = read_metadata(folder)
    trials = [entry for entry in meta["trials"] if entry["campaign"] == campaign]
    every = 1 if campaign == "p25" else EVERY  # a quarter of the stream is gaps as it is
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
        keep = _kept(data["time_s"], onset, release, every)
        if not streamed:
            keep &= data["time_s"] >= SETTLING_S
        runs.append(
            Run(
                name=name,
                time_s=(data["time_s"] - data["time_s"][onset])[keep],
                measured=places[keep],
                command={"set_pressure_Pa": pressure[keep]},
                group=name,
                order=order,
                use="test" if name in held_out else "fit",
                setup={"set_pressure_Pa": float(entry["set_pressure_Pa"])},
            )
        )
    # No trial was repeated, and the trackers' noise (4 to 20 um) is not what limits a model: the
    # best bend of every single sample leaves 0.05 to 0.17 mm rms at 100 to 350 mbar (0.12 mm all
    # in all), alike over 0.5 to 0.8 s. With every third sample kept, 0.12 mm that lasts for some
    # 18 to 25 samples says as much as white noise of 0.12 sqrt(20) = 0.5 mm
    sd = MODEL_SD * float(np.sqrt(EVERY / every))
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
            "recorded; no level was repeated: the noise stated is what no bend explains, by "
            f"how long it lasts; one sample of {every} is kept, one of {10 * every} beyond 1 s "
            "after a switch",
        ),
    )


def _kept(
    time: NDArray[np.float64], onset: int, release: int | None, every: int
) -> NDArray[np.bool_]:
    """Samples that tell something: each ``every``-th near the switches, few between."""
    since, count = time - time[onset], np.arange(len(time))
    lively = (since >= -REST_S) & (since <= LIVELY_S)
    if release is not None:
        lively |= np.abs(time - time[release] - 0.45) <= 0.55
    kept = (lively & (count % every == 0)) | ((count % (10 * every) == 0) & (since > 0.0))
    kept[onset] = True
    if release is not None:
        kept[release - 1 : release + 1] = True
    return np.asarray(kept)
