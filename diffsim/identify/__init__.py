"""Fit parameters of a simulator to recordings: priors, nuisances, uncertainties, correlations."""

from diffsim.identify.fitting import Fit, fit
from diffsim.identify.jacobian import Jacobian
from diffsim.identify.noise_model import Whitener, WhiteNoise
from diffsim.identify.parameter import Parameter
from diffsim.identify.problem import Problem

__all__ = ["Fit", "Jacobian", "Parameter", "Problem", "WhiteNoise", "Whitener", "fit"]
