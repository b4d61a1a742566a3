"""What do recordings of a released beam say before any simulation?

Frequency, damping and creep of every trial, and how far a repeat is off: nothing below that floor
can be judged. Without measured data (DIFFSIM_DATA) a virtual laboratory makes the recordings.

Expected of the measured beam: 7.7 Hz without the weight, 4.3 Hz with it. Running time: 1 s.

    python examples/data/ring_down.py
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import tempfile
from pathlib import Path

from diffsim.data import BeamStudy, beam_motion, find_dataset, load_beam_study, write_beam_study


def main(study: BeamStudy | None = None) -> dict[str, float]:
    """Frequencies [Hz], damping ratios, and the floors of the repeats [mm]."""
    if study is None:
        folder = find_dataset("silicone_beam")
        with tempfile.TemporaryDirectory() as made:
            study = load_beam_study(folder or write_beam_study(Path(made) / "beam"))
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
