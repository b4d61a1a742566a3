"""Faults of single groups of runs, judged against the scatter between sound ones.

A vehicle differs from day to day. What sound groups differ by is learned here as random effects:
base parameters stated per group or per run, whose spreads are found from groups with known faults.
A new group is then judged by itself: which causes of the library explain it, beyond that scatter.

Files in reading order: ``groups``, ``layout``, ``given`` (what is stated), ``local`` (one group,
linearized), ``marginal`` (scatter integrated out), ``learn`` (spreads and common parameters),
``states`` and ``candidates`` (what a group may be, with odds), ``evidence`` (one set in one group),
``verdict`` (what may be said), ``judging`` (all groups).
"""

from diffsim.diagnose.faults.judging import judge_faults
from diffsim.diagnose.faults.verdict import FaultReport, FaultVerdict, SetRow, Size, Spread

__all__ = ["FaultReport", "FaultVerdict", "SetRow", "Size", "Spread", "judge_faults"]
