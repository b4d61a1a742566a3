"""What do recordings of a released beam say before any simulation?

Frequency, damping and creep of every trial, and how far a repeat is off: nothing below that floor
can be judged. Without measured data (DIFFSIM_DATA) it reads recordings of a virtual laboratory.

Expected of the measured beam: 7.7 Hz without the weight, 4.3 Hz with it. Running time: 1 s.

    python examples/data/ring_down.py
"""

from __future__ import annotations

from diffsim.core.script import interruptible

from pathlib import Path

from diffsim.data import find_dataset
from examples.data import beam_motion
from examples.data.beam import BeamStudy, load_beam_study

VIRTUAL = Path(__file__).parents[1] / "demo" / "virtual_beam"


def main(study: BeamStudy | None = None) -> dict[str, float]:
    """Frequencies [Hz], damping ratios, and the floors of the repeats [mm]."""
    if study is None:
        study = load_beam_study(find_dataset("silicone_beam") or VIRTUAL)
    numbers = beam_motion.describe(study)
    found = {}
    for name, trial in numbers["trials"].items():
        found[f"{name}, frequency Hz"] = trial["frequency_Hz"]
        found[f"{name}, damping ratio"] = trial["damping_ratio"]
    for case, repeat in numbers["repeats"].items():
        found[f"{case}, repeats apart mm"] = 1e3 * repeat["vertical_rms_m"]
    return found


if __name__ == "__main__":
    with interruptible():
        for name, value in main().items():
            print(f"{name:32s} {value:.4f}")
