"""Fit parameters of a simulator to recordings: priors, nuisances, uncertainties, correlations."""

from diffsim.identify.parameter import Parameter

__all__ = ["Parameter"]
