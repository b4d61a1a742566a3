"""Any simulator: a function of parameters and a run, with the hooks that it offers to causes."""

from diffsim.systems.outside.description import OutsideDescription
from diffsim.systems.outside.effects import unknown_forces
from diffsim.systems.outside.environment import Environment
from diffsim.systems.outside.forces import PlaceForces
from diffsim.systems.outside.hooks import Place, command_groups, instruments
from diffsim.systems.outside.model import OutsideModel, SimulatorError
from diffsim.systems.outside.setup import outside_setup
from diffsim.systems.outside.source import Source

__all__ = [
    "Environment",
    "OutsideDescription",
    "OutsideModel",
    "Place",
    "PlaceForces",
    "SimulatorError",
    "Source",
    "command_groups",
    "instruments",
    "outside_setup",
    "unknown_forces",
]
