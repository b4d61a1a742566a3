"""Whether repeats differ by more than the set-up may: nuisances of runs against their priors.

A gain that jitters from run to run by far more than was stated leaves no scatter in the channels,
for the gain of each run, a base parameter, takes it up. The scatter is then in these parameters.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from scipy.stats import chi2

from diffsim.diagnose.gate_result import GateResult
from diffsim.diagnose.noise import UNREPEATABLE
from diffsim.identify import Fit

PREFIX = "repeats:"
CHANCE = 1e-3  # of so large a scatter where the priors hold: repeats are few


def repeatability_gate(fit: Fit) -> list[GateResult]:
    """One check for each kind of nuisance that every run has for itself (``name@run``).

    The deviation of its standardised values from their mean over a group of repeats is N(0, 1)
    after scaling, or less, as fits shrink it. Failed: the rms over all groups is above the limit of
    the channels' scatter, and so large that chance does not make it.

    Args:
        fit: With the effects that the evidence asks for, so that a drift over runs that has a name
            is not scatter.
    """
    known = {run.name: run.group for run in fit.problem.runs}
    values: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for i, parameter in enumerate(fit.problem.model.base):
        stem, _, run = parameter.name.partition("@")
        if run in known:
            values[stem][known[run]].append(float(fit.x[i]))
    out = []
    for stem, groups in values.items():
        repeats = [np.array(g) for g in groups.values() if len(g) > 1]
        freedom = sum(len(g) - 1 for g in repeats)
        if not freedom:
            continue
        total = sum(float(((g - g.mean()) ** 2).sum()) for g in repeats)
        ratio = float(np.sqrt(total / freedom))
        passed = ratio <= UNREPEATABLE or float(chi2.sf(total, freedom)) > CHANCE
        note = f"scatter of {stem} between repeats over what its prior allows"
        out.append(GateResult(f"{PREFIX}{stem}", passed, ratio, UNREPEATABLE, note))
    return out
