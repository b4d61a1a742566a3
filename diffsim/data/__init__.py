"""Recordings of real robots: loading, checking, signal analysis.

A *study* is the recordings of one system with what is known about them: ``load_study``,
``save_study``, ``check_study``.
"""

from diffsim.data.recording import Recording, find_dataset, load_csv
from diffsim.data.study import Channel, Command, Run, Study
from diffsim.data.study_check import Problem, check_study
from diffsim.data.study_file import load_study
from diffsim.data.study_save import save_study

__all__ = [
    "Channel",
    "Command",
    "Problem",
    "Recording",
    "Run",
    "Study",
    "check_study",
    "find_dataset",
    "load_csv",
    "load_study",
    "save_study",
]
