"""How finely equations must be stepped to be stable, where the description leaves that open."""

from __future__ import annotations

from diffsim.core.memo import Memo
from diffsim.data.study import Study
from diffsim.identify.model import SimModel
from diffsim.identify.numerics import Numerics
from diffsim.identify.stability import runs_away

MOST_PARTS = 64  # of a sample interval
_LAST: Memo[int] = Memo(1)


def parts_needed(study: Study, model: SimModel, formulas: str) -> int:
    """Parts of the sample interval with which the plain model does not run away.

    An explicit method grows without bounds where a step is long against the fastest time constant,
    such as that of a winding. How exact the steps are is another question, checked later.

    Args:
        study: Study with the recordings.
        model: Plain model, stepped once per sample.
        formulas: What the model is made of, in text. The check and the set-up of one command ask
            for the same study and formulas: the second one simulates nothing.

    Returns:
        1, or a power of two of which half is enough, too: parameters will move, and a quick look
        steps twice as far. 1 where no number up to ``MOST_PARTS`` helps.
    """
    return _LAST((study, formulas), lambda: _find_parts(study, model))


def _find_parts(study: Study, model: SimModel) -> int:
    runs = (*study.fit_runs, *study.select_runs) or study.runs
    parts = 1
    while parts <= MOST_PARTS:
        if not runs_away(model, runs, Numerics(time_step=1.0 / parts)):
            return parts if parts == 1 else 2 * parts
        parts *= 2
    return 1
