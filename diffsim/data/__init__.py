"""Recordings of real robots: loading and checking.

A *study* is the recordings of one system with what is known about them: ``load_study``,
``save_study``, ``check_study``.
"""

from diffsim.data.study import Channel, Command, Run, Study
from diffsim.data.study_check import Problem, check_study
from diffsim.data.study_file import find_dataset, load_study
from diffsim.data.study_save import save_study

__all__ = [
    "Channel",
    "Command",
    "Problem",
    "Run",
    "Study",
    "check_study",
    "find_dataset",
    "load_study",
    "save_study",
]
