"""What can be wrong with a simulation: every cause by a row of a table, and how it acts.

A scene offers five ports (``ports``): commands, readings, clocks, numbers, forces. A row of a table
beside this file (``catalogue``) says what a cause is called, where it acts, by which map or law,
and how large it may be without surprise, in magnitudes of the recordings (``scales``).
"""

from diffsim.causes.catalogue import all_rows, domains, rows
from diffsim.causes.commands import CommandGroup, command_cause, command_causes
from diffsim.causes.listing import list_causes
from diffsim.causes.own import OwnRow, own_causes
from diffsim.causes.plant import Place, Plant
from diffsim.causes.readings import Instrument, reading_cause
from diffsim.causes.row import Row
from diffsim.causes.scales import Scales
from diffsim.causes.scene import Scene

__all__ = [
    "CommandGroup",
    "Instrument",
    "OwnRow",
    "Place",
    "Plant",
    "Row",
    "Scales",
    "Scene",
    "all_rows",
    "command_cause",
    "command_causes",
    "domains",
    "list_causes",
    "own_causes",
    "reading_cause",
    "rows",
]
