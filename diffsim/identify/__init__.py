"""Models of recorded systems, effects on them, and fits: priors, nuisances, uncertainties."""

from diffsim.identify.effect import Effect
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.extended import ExtendedModel, extended_model
from diffsim.identify.fitting import Fit, fit
from diffsim.identify.jacobian import Jacobian
from diffsim.identify.model import Parameter, Scene, SimModel
from diffsim.identify.model_file import save_extended
from diffsim.identify.numerics import NumericalEffect, Numerics, coarse
from diffsim.identify.problem import Problem
from diffsim.identify.setup import DiagnosisSetup
from diffsim.identify.shape import MovingShape
from diffsim.identify.unknown import Unknown, UnknownDrift, UnknownForce, smooth_covariance
from diffsim.identify.whitening import Whitener, WhiteNoise

__all__ = [
    "DiagnosisSettings",
    "DiagnosisSetup",
    "Effect",
    "ExtendedModel",
    "Fit",
    "Jacobian",
    "MovingShape",
    "NumericalEffect",
    "Numerics",
    "Parameter",
    "Problem",
    "Scene",
    "SearchSettings",
    "SimModel",
    "Unknown",
    "UnknownDrift",
    "UnknownForce",
    "WhiteNoise",
    "Whitener",
    "coarse",
    "extended_model",
    "fit",
    "save_extended",
    "smooth_covariance",
]
