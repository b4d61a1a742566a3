"""The loop of thesis Alg. 7 on the starfish: identify, optimize the command, execute, repeat.

The robot is on its rig or in a virtual laboratory that shares no code with the model. Scripts of
``examples/sim_to_real`` run it; docs/sim_to_real.md says how.
"""

from labs.loop.command import Command, Limits, followed, open_close, sinusoid
from labs.loop.hardware import AwaitingRecordingError, FileHardware, Hardware
from labs.loop.identification import FitSettings, Identified, identify
from labs.loop.laboratory import Rig, VirtualLaboratory
from labs.loop.loop import sim_to_real
from labs.loop.measured import on_real_recording
from labs.loop.model import CHANNELS, Starfish
from labs.loop.recordings import import_starfish
from labs.loop.records import Iteration, LoopResult, LoopSettings
from labs.loop.rod_swimmer import Truth
from labs.loop.trajectory import TrajectorySettings, optimize, speed, travel_loss
from labs.loop.worth import worth_of_travel

__all__ = [
    "CHANNELS",
    "AwaitingRecordingError",
    "Command",
    "FileHardware",
    "FitSettings",
    "Hardware",
    "Identified",
    "Iteration",
    "Limits",
    "LoopResult",
    "LoopSettings",
    "Rig",
    "Starfish",
    "TrajectorySettings",
    "Truth",
    "VirtualLaboratory",
    "followed",
    "identify",
    "import_starfish",
    "on_real_recording",
    "open_close",
    "optimize",
    "sim_to_real",
    "sinusoid",
    "speed",
    "travel_loss",
    "worth_of_travel",
]
