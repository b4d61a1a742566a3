"""Whether a simulation runs away, as explicit steps do that are too long for the equations."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch

from diffsim.data.study import Run
from diffsim.identify.model import SimModel
from diffsim.identify.numerics import Numerics

MAX_GUESS_RATIO = 1e6  # times what was measured: no guess is that wrong


def runs_away(model: SimModel, runs: Iterable[Run], numerics: Numerics | None = None) -> bool:
    """Whether the plain model, at its best guess, leaves all that was measured far behind.

    Args:
        model: Plain model, without effects.
        runs: Runs that are simulated until one runs away.
        numerics: Factors on its settings; None: its own.
    """
    for run in runs:
        with torch.no_grad():
            predicted = model.predict(run, model.at_prior(), numerics=numerics)
        seen = np.nanmax(np.abs(run.measured), axis=0, initial=0.0)
        most = torch.from_numpy(np.where(seen > 0.0, MAX_GUESS_RATIO * seen, np.inf))
        if not bool((torch.isfinite(predicted) & (predicted.abs() <= most)).all()):
            return True
    return False
