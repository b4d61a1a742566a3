"""Recordings of real robots: loading, signal analysis, and virtual laboratories."""

from diffsim.data.beam import BeamGeometry, BeamStudy, BeamTrial, load_beam_study
from diffsim.data.recording import Recording, find_dataset, load_csv

__all__ = [
    "BeamGeometry",
    "BeamStudy",
    "BeamTrial",
    "Recording",
    "find_dataset",
    "load_beam_study",
    "load_csv",
]
