"""Sim-to-real: identify a simulated robot from hardware, optimize its command, execute, repeat."""

from diffsim.sim_to_real.command import Command, Limits, followed, sinusoid
from diffsim.sim_to_real.hardware import (
    AwaitingRecordingError,
    FileHardware,
    Hardware,
)
from diffsim.sim_to_real.identification import FitSettings, Identified, identify
from diffsim.sim_to_real.laboratory import VirtualLaboratory
from diffsim.sim_to_real.loop import sim_to_real
from diffsim.sim_to_real.measured import on_real_recording
from diffsim.sim_to_real.model import Starfish
from diffsim.sim_to_real.records import Iteration, LoopResult, LoopSettings
from diffsim.sim_to_real.trajectory import TrajectorySettings, optimize, travel_loss

__all__ = [
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
    "Starfish",
    "TrajectorySettings",
    "VirtualLaboratory",
    "followed",
    "identify",
    "on_real_recording",
    "optimize",
    "sim_to_real",
    "sinusoid",
    "travel_loss",
]
