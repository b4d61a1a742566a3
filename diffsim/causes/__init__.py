"""What can be wrong with a simulation: every cause by a row of a table, and how it acts.

A ``Scene`` has five ports: commands, readings, clocks, numbers, forces. A row of a table beside
this file (``catalogue``) says what a cause is called, where it acts, by which map or law, and how
large it may be without surprise, in magnitudes of the recordings (``scales``). A ``Plant`` is
what a described system tells of itself; from it ``list_causes`` lists the rows that suit it.
"""

from diffsim.causes.catalogue import all_rows, domains, rows
from diffsim.causes.commands import CommandGroup, command_cause
from diffsim.causes.listing import list_causes
from diffsim.causes.own import OwnRow, own_causes
from diffsim.causes.plant import Place, Plant
from diffsim.causes.readings import Instrument
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
    "domains",
    "list_causes",
    "own_causes",
    "rows",
]
