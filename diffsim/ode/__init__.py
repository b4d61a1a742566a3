"""Ordinary differential equations given by formulas, differentiable in states and parameters."""

from diffsim.ode.integrate import Ode

__all__ = ["Ode"]
