"""What a simulator from outside was commanded before its runs, where no study says it.

As of ``ode``: a run that rests without commands, and not with its first ones, began with them: what
is late hears them later. Unless the record moves at once while later commands come late. What is
late by less than a sample is asked from zero: a drive of 1.29 times the force whose sensor was
0.4 ms late left 1.24 times the noise with a first command that had stood.

Which first values had stood is told by the fitted runs alone: a study with a ``frame`` has it from
there. Those of a model that was saved without it had.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from diffsim.causes.scales import SCALES
from diffsim.core.arrays import Array
from diffsim.core.memo import Memo
from diffsim.data.study import Run, Study
from diffsim.identify.model import SimModel
from diffsim.identify.problem import PredictionError
from diffsim.systems.first_commands import FEWEST_READINGS, LATE, SAMPLES, is_late_behind_first

STOOD = "stood"  # place in a study's frame
# of what first commands move in ``SAMPLES``: a pendulum that hangs 0.1 mrad off is at 5e-4
RESTS = 0.01


class BeforeRuns:
    """Commands that were zero before a run.

    Args:
        model: Asked at its priors, so that no fit changes it.
        study: Recorded runs.
    """

    def __init__(self, model: SimModel, study: Study):
        self._model, self._study = model, study
        self._known: Memo[bool] = Memo()

    def zero(self, run: Run) -> frozenset[str]:
        """Names of the commands of a run that were zero before it."""
        begun = frozenset(run.command) - self.stood
        return begun if begun and self._rests(run) else frozenset()

    @cached_property
    def stood(self) -> frozenset[str]:
        """Commands whose first values had been heard before fitted runs that begin at rest."""
        frame = self._study.frame
        if STOOD in frame:
            return frozenset(frame[STOOD])
        sd = np.array([np.nan if c.sd is None else c.sd for c in self._study.channels])
        if SCALES in frame or np.isnan(sd).all():  # without a noise nothing is clear
            return frozenset(name for run in self._study.runs for name in run.command)
        begun = [run for run in self._study.fit_runs if self._rests(run)]
        return frozenset(
            name
            for name in dict.fromkeys(name for run in begun for name in run.command)
            if self._has_stood(name, [run for run in begun if name in run.command], sd)
        )

    def _has_stood(self, name: str, begun: Sequence[Run], sd: Array) -> bool:
        """Whether a command had its first values before runs that begin at rest."""
        try:
            records = [(self._ways(run, name), run.measured) for run in begun]
        except PredictionError:  # the simulator refuses what was never commanded
            return True
        return is_late_behind_first(records, sd)

    def _rests(self, run: Run) -> bool:
        return self._known(run, lambda: self._is_at_rest(run))

    def _is_at_rest(self, run: Run) -> bool:
        """Whether a run rests where it starts without commands, and not with its first ones."""
        if len(run.time_s) < FEWEST_READINGS:
            return False
        if not any(u[0] != 0.0 for u in run.command.values()):
            return False  # first values or zero: it is one
        first = {name: np.full_like(u, u[0]) for name, u in run.command.items()}
        none = {name: np.zeros_like(u) for name, u in run.command.items()}
        try:
            with_first, without = (np.ptp(self._begin(run, u), axis=0) for u in (first, none))
        except (PredictionError, ValueError):
            # it does not go far without commands, or with the same ones, or has whole runs alone
            return False
        return bool((without <= RESTS * with_first).all() and with_first.any())

    def _ways(self, run: Run, name: str) -> Array:
        """The begin of a run without a delay, and with one command late: behind its first value,
        and behind zero, (1 + 2 len(LATE), num_samples, num_channels)."""
        values = run.command[name]
        made = [self._begin(run, run.command)]
        for first in (values[0], 0.0):
            for late in map(int, LATE):
                told = np.concatenate([np.full(late, first), values[:-late]])
                made.append(self._begin(run, {**run.command, name: told}))
        return np.array(made)

    def _begin(self, run: Run, command: Mapping[str, Array]) -> Array:
        """Channels of the first samples under other commands."""
        few = slice(SAMPLES)
        begun = replace(
            run,
            time_s=run.time_s[few],
            measured=run.measured[few],
            command={name: np.asarray(u)[few] for name, u in command.items()},
            columns={name: u[few] for name, u in run.columns.items()},
            raw={},
        )
        return self._model.predict(begun, self._model.at_prior()).detach().numpy()
