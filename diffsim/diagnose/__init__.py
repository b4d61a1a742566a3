"""Show what a simulator gets wrong, name the cause, extend the model, measure the gain.

From ``study.yaml`` to the verdict one channel passes through these files, to be read in this
order:

1. Recordings: ``data/study_file``, ``data/table``, ``data/study``, ``core/check``; the chosen model
   and causes: ``cli/diagnose_inputs``.
2. What is fitted: ``identify/model``, ``effect``, ``sizes``, ``problem``, ``jacobian``,
   ``linearization``, ``fitting``, ``unknown``.
3. The pipeline, in the order of its steps: ``diagnose/diagnosis``.
4. ``gates``, ``gradients``, ``refine``: data, repeatability, gradients, numerical settings, which
   are refined where they are too coarse.
5. ``noise``: the noise floor and its whitening.
6. ``fit``, ``windows``: the plain model, over growing parts of the runs where it must be;
   ``gauss_newton``, ``optimum``: in a trust region with Broyden updates.
7. ``screen``: scores of all candidates at the null fit.
8. ``evidence``, ``simulations``, ``scan``, ``search``: Laplace evidence of sets of effects, what
   was simulated for it, and where fits of effects with kinks start.
9. ``judge``, ``gain``: one verdict; unknown causes face the repeats (``crosscheck``), names face
   held-out runs.
10. ``records``, ``tables``, ``report``, ``force_map``: the evidence as it is read and saved.

One record passes on to the next, and none is changed: ``Case`` (what is given), ``Null`` (noise
floor and null fit), ``Search`` (what was weighed), ``Judgment`` (what may be said), ``Report``.
"""

from diffsim.diagnose.diagnosis import diagnose
from diffsim.diagnose.force_map import ForceMap, force_map
from diffsim.diagnose.gain import Gain, gain
from diffsim.diagnose.gates import GateResult
from diffsim.diagnose.next_run import NextRun, next_run
from diffsim.diagnose.records import BaseRow, CauseRow, ErrorRow, Interval, OutsideRow
from diffsim.diagnose.report import Report
from diffsim.diagnose.tables import EffectRow, HypothesisRow

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
