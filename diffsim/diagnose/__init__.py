"""Show what a simulator gets wrong, name the cause, extend the model, measure the gain."""

from diffsim.diagnose.diagnosis import diagnose
from diffsim.diagnose.effect import Effect
from diffsim.diagnose.extended import ExtendedModel, extended_model
from diffsim.diagnose.gain import Gain, gain
from diffsim.diagnose.libraries import library
from diffsim.diagnose.model import Numerics, Scene, SimModel
from diffsim.diagnose.model_file import load_extended, save_extended
from diffsim.diagnose.next_run import NextRun, next_run
from diffsim.diagnose.report import EffectRow, GateResult, HypothesisRow, Report
from diffsim.diagnose.search import SearchSettings
from diffsim.diagnose.stages import DiagnosisSettings
from diffsim.diagnose.unknown import Unknown, UnknownDrift, UnknownForce, smooth_covariance

__all__ = [
    "DiagnosisSettings",
    "Effect",
    "EffectRow",
    "ExtendedModel",
    "Gain",
    "GateResult",
    "HypothesisRow",
    "NextRun",
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
    "gain",
    "library",
    "load_extended",
    "next_run",
    "save_extended",
    "smooth_covariance",
]
