"""Readings as a user reads them: in the unit of the recordings, scaled readings turned back."""

from __future__ import annotations

import numpy as np
import torch

from diffsim.core.arrays import Array
from diffsim.core.expression import parse_expression
from diffsim.core.units import factor
from diffsim.data.signal import step_of
from diffsim.data.study import Channel, Command, Study

MOST_STEPS = 3  # of channels that are said


def shown(of: Channel | Command, values: Array) -> Array:
    """Values in the unit in which a user reads them.

    Args:
        of: What was measured or commanded.
        values: In its ``unit``, any shape.

    Returns:
        The same shape, in ``shown_unit``, or in ``unit`` where none is stated.
    """
    formula = of.shown_formula if isinstance(of, Channel) else None
    if formula is None:
        times = factor(of.unit, of.shown_unit) if of.unit and of.shown_unit else 1.0
        return times * np.asarray(values)
    given = {of.name: torch.from_numpy(np.array(values, dtype=np.float64))}
    return np.asarray(parse_expression(formula, [of.name])(given).numpy())


def shown_change(of: Channel, at: Array, change: Array) -> Array:
    """How far values shown lie above those of ``at - change``.

    Args:
        of: What was measured.
        at: Values in its ``unit``, any shape.
        change: What they have more than others, in its ``unit``, of the same shape.

    Returns:
        The same shape, in ``shown_unit``, or in ``unit`` where none is stated.
    """
    if of.shown_unit is None:
        return np.asarray(change)
    if of.shown_formula is None:
        return shown(of, change)  # a factor
    return shown(of, at) - shown(of, at - change)


def unit_of_steps(of: Channel) -> str:
    """Unit in which a user reads steps of a channel: a formula gives values, and no steps."""
    return of.unit if of.shown_formula else of.shown_unit or of.unit


def shown_step(of: Channel, size: float) -> str:
    """A step of a reading with its unit, where no value is known at which it was taken."""
    unit = unit_of_steps(of)
    return f"{size * factor(of.unit, unit):.3g}{'' if unit == '-' else f' {unit}'}"


def resolution_words(study: Study) -> str:
    """How fine the record is, which is said where a delay is named.

    Args:
        study: Study whose fitted runs are asked; all where none is.
    """
    runs = study.fit_runs or study.runs
    steps_s = [(np.diff(run.time_s), run.row_s) for run in runs]
    rows_s = np.concatenate(
        [s if of is None else np.full(len(s), of) for s, of in steps_s] or [np.empty(0)]
    )
    if not len(rows_s):
        return ""
    steps = []
    for channel, values in zip(
        study.channels, np.concatenate([r.measured for r in runs]).T, strict=True
    ):
        if (step := step_of(values)) is not None and step > (channel.sd or 0.0):
            steps.append(f", one step of {channel.name} {shown_step(channel, step)}")
    row_s = float(np.median(rows_s))
    row = f"{row_s:.3g} s" if row_s >= 1.0 else f"{1e3 * row_s:.3g} ms"
    return f"One row of the record is {row}{''.join(steps[:MOST_STEPS])}."
