"""Sim-to-real: identify a simulated robot from hardware, optimize its command, execute, repeat."""

from diffsim.sim_to_real.command import Command, Limits, followed, open_close, sinusoid
from diffsim.sim_to_real.hardware import (
    AwaitingRecordingError,
    FileHardware,
    Hardware,
)
from diffsim.sim_to_real.identification import FitSettings, Identified, identify
from diffsim.sim_to_real.laboratory import Rig, VirtualLaboratory
from diffsim.sim_to_real.loop import sim_to_real
from diffsim.sim_to_real.measured import on_real_recording
from diffsim.sim_to_real.model import CHANNELS, Starfish
from diffsim.sim_to_real.records import Iteration, LoopResult, LoopSettings
from diffsim.sim_to_real.rod_swimmer import Truth
from diffsim.sim_to_real.tracking import BestCommand, Tracking, TrackingTask, best_command
from diffsim.sim_to_real.trajectory import TrajectorySettings, optimize, speed, travel_loss
from diffsim.sim_to_real.worth import Worth, worth, worth_of_travel

__all__ = [
    "CHANNELS",
    "AwaitingRecordingError",
    "BestCommand",
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
    "Tracking",
    "TrackingTask",
    "TrajectorySettings",
    "Truth",
    "VirtualLaboratory",
    "Worth",
    "best_command",
    "followed",
    "identify",
    "on_real_recording",
    "open_close",
    "optimize",
    "sim_to_real",
    "sinusoid",
    "speed",
    "travel_loss",
    "worth",
    "worth_of_travel",
]
