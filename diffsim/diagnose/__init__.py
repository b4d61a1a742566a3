"""Show what a simulator gets wrong, name the cause, extend the model, measure the gain.

From ``study.yaml`` to the verdict one channel passes through these files, to be read in this
order:

1. Recordings: ``data/study_file``, ``data/table``, ``data/study``, ``core/check``; the chosen model
   and causes: ``cli/diagnose_inputs``.
2. What is fitted: ``identify/model``, ``effect``, ``sizes``, ``problem``, ``jacobian``,
   ``linearization``, ``fitting``, ``unknown``.
3. The pipeline, in the order of its steps: ``diagnose/diagnosis``. Each of the five folders below
   imports only from those before it.
4. ``checks``: ``gates`` (data), ``numerics`` (steps, mesh, tolerance), ``gradients``, ``noise``
   (the noise floor and its whitening).
5. ``search``: ``fit``, ``gauss_newton`` (the plain model, by Gauss-Newton in a trust region),
   ``evidence``, ``optimum``, ``simulations``, ``fitted_sets``, ``search``, ``scan`` (Laplace
   evidence of sets of effects, and what was simulated for it).
6. ``discover``: ``stage``, ``screen``, ``forms`` (a law that nobody listed, where the answer leaves
   room for one).
7. ``judge``: ``judge`` (one verdict; unknown causes face the repeats, ``crosscheck``, names face
   runs that were not fitted, ``gain`` and ``left_out``), ``averaging``, ``stand_ins``,
   ``data_sheet`` (its ranges are saved), ``preconditions`` (of "certain"), ``apart`` (of devices).
   The answer is frozen here. Test runs are looked at once: ``unseen``; new runs later: ``frozen``.
8. ``say``: ``causes`` (a verdict per cause), ``headline``, ``wording``, ``tables``, ``assemble``,
   ``report``, ``force_map``: the answer as it is read and saved.

``faults`` is a way of its own through the same parts: groups of runs with a fault each.

One record passes on to the next, and none is changed: ``Case`` (what is given), ``Null`` (noise
floor and null fit), ``Search`` (what was weighed), ``Judgment`` (what may be said), ``Report``.
"""

from diffsim.diagnose.checks.gates import GateResult
from diffsim.diagnose.diagnosis import diagnose
from diffsim.diagnose.judge.gain import Gain, gain
from diffsim.diagnose.judge.records import BaseRow, CauseRow, ErrorRow, Interval, OutsideRow
from diffsim.diagnose.say.force_map import ForceMap, force_map
from diffsim.diagnose.say.next_run import NextRun, next_run
from diffsim.diagnose.say.report import Report
from diffsim.diagnose.say.tables import EffectRow, HypothesisRow

__all__ = [
    "BaseRow",
    "CauseRow",
    "EffectRow",
    "ErrorRow",
    "ForceMap",
    "Gain",
    "GateResult",
    "HypothesisRow",
    "Interval",
    "NextRun",
    "OutsideRow",
    "Report",
    "diagnose",
    "force_map",
    "gain",
    "next_run",
]
