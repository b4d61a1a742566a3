"""A column in another unit is told by the model, unless a number of the model may be so large."""

import numpy as np
import pytest

from diffsim.data.study_file import load_study
from diffsim.diagnose.checks.whole_record import column_problems
from diffsim.systems.registry import setup_of
from labs.records.rigs import wheel


@pytest.mark.parametrize(
    ("times", "percent", "said"),
    [(30.0 / np.pi, 5, "rpm"), (30.0 / np.pi, 1000, None), (1.3, 5, None), (5.0, 5, None)],
)
def test_a_factor_between_units_is_a_fault_where_no_number_may_be_it(
    times, percent, said, tmp_path
):
    rig = wheel(np.random.default_rng(5))
    tables = {run: {**t, "voltage_V": t["voltage_V"] / times} for run, t in rig.tables.items()}
    model = {**rig.study["model"], "define": {"wanted": "gain*drive"}}
    model["parameters"] = {**model["parameters"], "gain": {"value": 6.0, "percent": percent}}
    study = load_study(rig.changed(tables, model=model).write(tmp_path / "rig"))
    problems = list(column_problems(study, setup_of(study)))
    assert [p.where for p in problems] == (["command drive"] if said else []), problems
    assert not said or (said in problems[0].message and "times 9.5493 " in problems[0].message)
