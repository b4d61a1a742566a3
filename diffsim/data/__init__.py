"""Recordings of real robots: loading, checking, signal analysis.

A *study* is the recordings of one system with what is known about them: ``load_study``,
``save_study``, ``check_study``.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from diffsim.data.recording import Recording, find_dataset, load_csv
from diffsim.data.study import Channel, Command, Run, Study
from diffsim.data.study_check import Problem, check_study
from diffsim.data.study_file import load_study
from diffsim.data.study_save import save_study

if TYPE_CHECKING:
    from diffsim.data.ball_video import ball_tracks_study, ball_video_study

#: What few need, and what takes a second to import: loaded when it is asked for.
_LATE = {
    "ball_tracks_study": "ball_video",
    "ball_video_study": "ball_video",
}


def __getattr__(name: str) -> Any:
    if name in _LATE:
        return getattr(import_module(f"{__name__}.{_LATE[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [
    "Channel",
    "Command",
    "Problem",
    "Recording",
    "Run",
    "Study",
    "ball_tracks_study",
    "ball_video_study",
    "check_study",
    "find_dataset",
    "load_csv",
    "load_study",
    "save_study",
]
