"""One bounded L-BFGS: scipy's algorithm with a budget, a failure wall, a log and a resume.

    >>> from diffsim import optim
    >>> log = optim.Log("run.jsonl")
    >>> result = optim.minimize(loss_and_gradient, start, (lower, upper), log=log)
    >>> result.x, result.value, result.ended

The room stands directly above ``core``: it knows no simulator.
"""

from diffsim.optim.evaluation import Evaluation, Progress, Sample
from diffsim.optim.log import Log, LogError
from diffsim.optim.minimize import minimize
from diffsim.optim.multi_start import MultiStart, multi_start, screen, uniform_points
from diffsim.optim.options import Budget, Options, Tolerances, Wall
from diffsim.optim.progress_bar import progress_bar
from diffsim.optim.result import Result

__all__ = [
    "Budget",
    "Evaluation",
    "Log",
    "LogError",
    "MultiStart",
    "Options",
    "Progress",
    "Result",
    "Sample",
    "Tolerances",
    "Wall",
    "minimize",
    "multi_start",
    "progress_bar",
    "screen",
    "uniform_points",
]
