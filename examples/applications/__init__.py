"""The thesis's applications (4.1.6, Tables 4.2 to 4.4): what they share, and their table.

An application is a soft body, a vector of parameters within bounds, a simulation of them and a
loss. The scripts under ``examples/applications`` each build one; this package optimizes it with a
chosen solver, draws it, records it, and compares the solvers.
"""

from examples.applications.application import SOLVERS, Application, Parameters, solver_options
from examples.applications.minimize import Evaluation, Outcome, evaluate, minimize
from examples.applications.normalize import random_losses

__all__ = [
    "SOLVERS",
    "Application",
    "Evaluation",
    "Outcome",
    "Parameters",
    "evaluate",
    "minimize",
    "random_losses",
    "solver_options",
]
