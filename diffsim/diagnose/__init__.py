"""Show what a simulator gets wrong, name the cause, extend the model, measure the gain."""

from diffsim.diagnose.diagnosis import diagnose
from diffsim.diagnose.force_map import ForceMap, force_map
from diffsim.diagnose.gain import Gain, gain
from diffsim.diagnose.gates import GateResult
from diffsim.diagnose.next_run import NextRun, next_run
from diffsim.diagnose.report import Report
from diffsim.diagnose.tables import EffectRow, HypothesisRow

__all__ = [
    "EffectRow",
    "ForceMap",
    "Gain",
    "GateResult",
    "HypothesisRow",
    "NextRun",
    "Report",
    "diagnose",
    "force_map",
    "gain",
    "next_run",
]
