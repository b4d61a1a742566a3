"""What records ask of a model of formulas before anything is fitted to them: a list, in its order.

A mend looks at the records and at the model as the mends before it left it, and changes the model
or adds base parameters. None is a cause. What a saved model has kept of a mend stands in the
study's ``frame``.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np
import torch

from diffsim.core.memo import Memo
from diffsim.data.study import Run
from diffsim.identify.model import Parameter, SimModel
from diffsim.identify.numerics import Numerics
from diffsim.systems.ode.described import FormulaSystem, model_of
from diffsim.systems.ode.gaps import find_gaps
from diffsim.systems.ode.names import Reader
from diffsim.systems.ode.pieces import cut_run, start_name
from diffsim.systems.ode.swings import SPREAD, frequencies_to_try, strongest_frequency, swing_names

Mend = Callable[[FormulaSystem, Reader], FormulaSystem]
_Found = TypeVar("_Found")
MAX_GUESS_RATIO = 1e6  # times what was measured: no guess is that wrong
PARTS = "steps_per_sample"  # place in a study's frame
MOST_PARTS = 64  # of a sample interval
_KNOWN: Memo[object] = Memo()


def mended(system: FormulaSystem, reader: Reader) -> FormulaSystem:
    """A system that moves, with all mends that the records of its study ask for.

    Args:
        reader: Receives what was taken for granted.
    """
    for mend in MENDS:
        system = mend(system, reader)
    return system


def _jump_inside_gaps(system: FormulaSystem, reader: Reader) -> FormulaSystem:
    """When a held command changed in a gap of the rows is a number of the run."""
    formulas = [formula for name, formula in system.inputs.items() if system.held[name]]
    held = sorted({name for formula in formulas for name in formula.names})
    found = {run.name: find_gaps(run, held) for run in system.study.runs}
    gaps = {name: of_run for name, of_run in found.items() if of_run}
    more = [gap.parameter for of_run in gaps.values() for gap in of_run if not gap.swept]
    return replace(system, gaps=gaps, base=system.base.with_further(more))


def _divide_steps(system: FormulaSystem, reader: Reader) -> FormulaSystem:
    """As many steps of the integrator per sample as keep the plain model from running away.

    An explicit method grows without bounds where a step is long against the fastest time constant,
    such as that of a winding. How exact the steps are is another question, checked later.
    """
    study = system.study
    if (kept := study.frame.get(PARTS)) is not None:
        return replace(system, parts=int(kept or 1))
    if system.motion.time_step is not None:
        return system
    runs = (*study.fit_runs, *study.select_runs) or study.runs
    parts = _once(system, ("parts", runs), partial(_count_parts, model_of(system), runs))
    system = replace(system, parts=parts)
    if parts > 1:
        reader.report(
            "time_step",
            f"the equations are too fast for one step per sample: {parts} are taken; "
            f"state `time_step` [s] to choose, such as {system.step:.2g}",
            "note",
        )
    return system


def _count_parts(model: SimModel, runs: tuple[Run, ...]) -> int:
    """1, or a power of two of which half is enough, too: parameters will move, and a quick look
    steps twice as far. 1 where no number up to ``MOST_PARTS`` helps."""
    parts = 1
    while parts <= MOST_PARTS:
        if not _runs_away(model, runs, Numerics(time_step=1.0 / parts)):
            return parts if parts == 1 else 2 * parts
        parts *= 2
    return 1


def _swing_as_seen(system: FormulaSystem, reader: Reader) -> FormulaSystem:
    """Frequencies of swings begin where the record of each run suggests."""
    model, seen = model_of(system), dict[str, Parameter]()
    base = {p.name: p for p in system.base.base}
    for swing in system.motion.swings:
        for run in system.study.runs:
            name, tried = f"{swing_names(swing)[2]}@{run.name}", frequencies_to_try(run)
            if not len(tried) or not np.isfinite(run.measured).any():
                continue
            find = partial(strongest_frequency, model, swing, run, tried)
            value = _once(system, ("swing", swing.name, run), find)
            sd = SPREAD / float(np.ptp(run.time_s))
            seen[name] = replace(base[name], value=value, sd=sd)
    return replace(system, base=system.base.with_priors(tuple((base | seen).values())))


def _cut_runs(system: FormulaSystem, reader: Reader) -> FormulaSystem:
    """Runs in which the start stops telling are cut; each piece begins with states of its own."""
    model = model_of(system)
    runs = [run for run in system.study.runs if np.isfinite(run.measured).any()]
    found = {run: _once(system, ("pieces", run), partial(cut_run, run, model)) for run in runs}
    more = [
        Parameter(start_name(state, piece, run), value, piece.sd[state])
        for run, pieces in found.items()
        for piece in pieces
        for state, value in piece.start.items()
    ]
    pieces = {run.name: of_run for run, of_run in found.items() if of_run}
    return replace(system, pieces=pieces, base=system.base.with_further(more))


#: the first asks the records alone; steps must be stable before a run is simulated, frequencies
#: stand before the model is asked whether runs are to be cut
MENDS: tuple[Mend, ...] = (_jump_inside_gaps, _divide_steps, _swing_as_seen, _cut_runs)


def _once(system: FormulaSystem, about: Hashable, find: Callable[[], _Found]) -> _Found:
    """What was found of some records: the check and the set-ups of one command ask for the same."""
    found: _Found = _KNOWN((about, system.formulas), find)  # type: ignore[assignment]
    return found


def _runs_away(model: SimModel, runs: Iterable[Run], numerics: Numerics) -> bool:
    """Whether the plain model, at its best guess, leaves all that was measured far behind, as
    explicit steps do that are too long for the equations."""
    for run in runs:
        with torch.no_grad():
            predicted = model.predict(run, model.at_prior(), numerics=numerics)
        seen = np.nanmax(np.abs(run.measured), axis=0, initial=0.0)
        most = torch.from_numpy(np.where(seen > 0.0, MAX_GUESS_RATIO * seen, np.inf))
        if not bool((torch.isfinite(predicted) & (predicted.abs() <= most)).all()):
            return True
    return False
