"""Show what a simulator gets wrong, name the cause, extend the model, measure the gain."""

from diffsim.diagnose.diagnosis import diagnose
from diffsim.diagnose.effect import Effect
from diffsim.diagnose.extended import extended_model
from diffsim.diagnose.force_map import ForceMap, force_map
from diffsim.diagnose.gain import Gain, gain
from diffsim.diagnose.libraries import library
from diffsim.diagnose.model import Scene, SimModel
from diffsim.diagnose.next_run import NextRun, next_run
from diffsim.diagnose.numerical import NumericalEffect
from diffsim.diagnose.numerics import Numerics
from diffsim.diagnose.report import EffectRow, GateResult, HypothesisRow, Report
from diffsim.diagnose.search import SearchSettings
from diffsim.diagnose.stages import DiagnosisSettings
from diffsim.diagnose.unknown import Unknown, UnknownDrift, UnknownForce, smooth_covariance

__all__ = [
    "DiagnosisSettings",
    "Effect",
    "EffectRow",
    "ForceMap",
    "Gain",
    "GateResult",
    "HypothesisRow",
    "NextRun",
    "NumericalEffect",
    "Numerics",
    "Report",
    "Scene",
    "SearchSettings",
    "SimModel",
    "Unknown",
    "UnknownDrift",
    "UnknownForce",
    "diagnose",
    "extended_model",
    "force_map",
    "gain",
    "library",
    "next_run",
    "smooth_covariance",
]
