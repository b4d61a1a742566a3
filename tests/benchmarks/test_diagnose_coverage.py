"""Sizes from disjoint parts: how studies are cut, and when two sizes agree."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.diagnose_coverage import Outcome, Pair, Size, outcome_of, parts_of, total_of
from diffsim.data.study import TIMELESS, Run, Study
from tests.diagnose import linear


def run(name, group, use="fit", **setup) -> Run:
    made = linear.run(name, 1)
    return replace(made, group=group, use=use, setup=setup)


def study_of(*runs) -> Study:
    return Study("s", "ode", linear.CHANNELS, runs)


def names(parts):
    return [[r.name for r in part.fit_runs] for part in parts]


def test_commands_are_dealt_in_turn_and_tests_stay_out():
    runs = [run(f"{g}{k}", g) for g in "abcd" for k in range(2)]
    runs += [run("chosen", "e", use="select"), run("kept", "f", use="test")]
    cut, parts = parts_of(study_of(*runs))
    assert cut == "5 commands"
    assert names(parts) == [["a0", "a1", "c0", "c1", "chosen"], ["b0", "b1", "d0", "d1"]]


def test_runs_are_dealt_where_commands_are_too_few_and_points_are_shared():
    points = run("points", "points", **{TIMELESS: True})
    cut, parts = parts_of(study_of(points, run("a0", "a"), run("a1", "a"), run("b0", "b")))
    assert cut == "3 runs"
    assert names(parts) == [["points", "a0", "b0"], ["points", "a1"]]


def test_one_run_is_not_cut():
    points = run("points", "points", **{TIMELESS: True})
    with pytest.raises(ValueError, match="1 run, and a later part"):
        parts_of(study_of(points, run("a", "a"), run("kept", "b", use="test")))


def test_a_set_that_cannot_be_cut_is_named_with_the_reason():
    found = outcome_of("no_such_data_set")
    assert found.row.startswith("| no_such_data_set | left out: ") and not found.pairs
    assert total_of([found]) == "No size was told by two parts."


def size(value, half, noise_only, is_cause=True):
    return Size("p", "drag", "N", value, half, noise_only, is_cause)


def test_sizes_agree_within_both_half_widths():
    near = Pair(size(1.0, 0.3, 0.1), size(1.45, 0.4, 0.1))
    far = Pair(size(1.0, 0.3, 0.1, False), size(1.55, 0.4, 0.1, False))
    assert near.agrees and not near.agrees_unwidened and not far.agrees
    assert near.times_apart == pytest.approx(0.45 / np.hypot(0.3, 0.4))
    outcome = Outcome("set", "4 runs", (near, far), 12.0)
    assert outcome.row.startswith(
        "| set | 4 runs | 1 of 2 | 1 of 1 | 0 of 2 | drag: 1 ± 0.3 against"
    )
    assert total_of([outcome, Outcome("other", "not cut: why")]) == (
        "1 of 2 pairs of 1 data sets agree within their 90 % intervals (50%); 0 would by the noise "
        "alone."
    )
