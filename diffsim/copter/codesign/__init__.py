"""Co-optimization of multicopters: shape, rotor directions, spins and hover (thesis 3.4)."""

from diffsim.copter.codesign.api import codesign
from diffsim.copter.codesign.arms import ArmSpace
from diffsim.copter.codesign.cases import Demands
from diffsim.copter.codesign.choices import Chosen, choose
from diffsim.copter.codesign.limits import Limits
from diffsim.copter.codesign.metrics import METRICS, CurrentModel
from diffsim.copter.codesign.options import AlternatingOptions, SearchOptions
from diffsim.copter.codesign.pareto import pareto_front
from diffsim.copter.codesign.result import CoDesignError, CoDesignResult, StartRecord
from diffsim.copter.codesign.space import DesignSpace

__all__ = [
    "METRICS",
    "AlternatingOptions",
    "ArmSpace",
    "Chosen",
    "CoDesignError",
    "CoDesignResult",
    "CurrentModel",
    "Demands",
    "DesignSpace",
    "Limits",
    "SearchOptions",
    "StartRecord",
    "choose",
    "codesign",
    "pareto_front",
]
