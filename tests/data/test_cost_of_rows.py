"""The cost of reading and checking a record grows with its rows, counted in bytes and calls."""

import sys
import tracemalloc

import numpy as np
import pytest

from diffsim.data import refresh
from diffsim.data.record import record_findings
from diffsim.data.shared_rows import shared_stretches
from diffsim.data.study import Channel, Command, Run, Study
from diffsim.data.table import Table
from diffsim.diagnose.checks.gates import alike_channels


def study_of(rows, channels=2):
    rng, t = np.random.default_rng(0), 0.005 * np.arange(rows)
    runs = []
    for k, use in enumerate(("fit", "fit", "test")):
        goal = np.sin(np.arange(1, channels + 1) * t[:, None] + k)
        seen = goal + rng.normal(0.0, 1e-3, goal.shape)
        command = {f"goal_{i}": goal[:, i] for i in range(channels)}
        runs.append(Run(f"r{k}", t, seen, command, f"r{k}", k, use))
    names = [Channel(f"x_{i}", "rad", "angle", sd=1e-3) for i in range(channels)]
    known = tuple(Command(f"goal_{i}", "rad") for i in range(channels))
    return Study("long", "ode", tuple(names), tuple(runs), commands=known)


def refreshed(study):
    return refresh.refresh_period((run.time_s, run.measured[:, 0]) for run in study.runs)


def cost(work, study):
    """Most bytes that are held at a time, and calls of Python functions."""
    calls = 0

    def count(frame, event, arg):
        nonlocal calls
        calls += event == "call"

    tracemalloc.start()
    sys.setprofile(count)
    work(study)
    sys.setprofile(None)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most, calls


@pytest.mark.parametrize("work", [record_findings, refreshed, alike_channels])
def test_memory_grows_with_rows_and_calls_do_not(work):
    small, large = study_of(4_000), study_of(16_000)
    work(study_of(1_000))  # what is imported late is no cost of rows
    (bytes_small, calls_small), (bytes_large, calls_large) = cost(work, small), cost(work, large)
    assert bytes_large < 5.0 * bytes_small + 1e6
    assert bytes_large < 40 * sum(run.measured.nbytes for run in large.runs)
    assert calls_large < 1.2 * calls_small + 200


def test_a_large_table_of_numbers_is_one_array_and_says_what_the_slow_way_says(tmp_path):
    values = np.random.default_rng(1).normal(size=(7_000, 4)).round(9)
    values[:, 0] = np.arange(7_000)
    lines = ["time_s,a,b,c", *(",".join(f"{v:.9g}" for v in row) for row in values)]
    path = tmp_path / "run.csv"
    path.write_text("\n".join(lines) + "\n")
    fast = Table(path, "run")
    np.testing.assert_array_equal(fast.numbers("b"), [float(r.split(",")[2]) for r in lines[1:]])
    assert fast.texts("time_s")[7] == "7" and fast.lines[-1] == 7_001 and fast.is_number["c"]
    for row, cell in ((3_000, "inf"), (20, "x"), (40, "")):
        broken = lines.copy()
        broken[row] = ",".join([*broken[row].split(",")[:3], cell])
        path.write_text("\n".join(broken) + "\n")
        if cell:
            with pytest.raises(ValueError, match=f"row {row + 1}, column c"):
                Table(path, "run").numbers("c")
        else:
            assert np.isnan(Table(path, "run").numbers("c")[row - 1])


def test_stretches_that_are_shared_are_found_once_and_whole():
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(300, 3)), rng.normal(size=(200, 3))
    b[40:90] = a[120:170]
    b[60, 1] = a[140, 1] = np.nan
    assert list(shared_stretches([a, b], lambda *_: False)) == [(0, 1, 40, 50)]
    assert list(shared_stretches([a, b], lambda *_: True)) == []
    still = np.zeros((400, 1))
    assert list(shared_stretches([still, still.copy()], lambda *_: False, distinct=True)) == []
