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


@pytest.mark.parametrize(
    ("unit", "read", "said"),
    [("1/min", "w", True), ("rpm", "w", False), ("Hz", "w", True), ("Hz", "w/(2*pi)", False)],
)
def test_turns_that_a_unit_does_not_count_are_told_beside_friction(unit, read, said, tmp_path):
    """Drehzahl in 1/min: 2 pi less than rad/s, which inertia and friction took up together."""
    t = 0.02 * np.arange(400)
    for name, rate in (("a", 0.9), ("b", 1.4)):
        volts, speed = 8.0 * np.sign(np.sin(rate * t)), [0.0]
        for u in volts[:-1]:
            w = speed[-1]
            speed.append(w + 0.02 * (u - 1.2 * np.tanh(20.0 * w) - 0.08 * w) / 0.05)
        turns = 60.0 if unit == "1/min" else 1.0
        shown = np.array(speed) * (30.0 / np.pi if unit == "rpm" else turns / (2.0 * np.pi))
        table = np.c_[t, volts, shown]
        head = "time_s,u,n"
        np.savetxt(tmp_path / f"{name}.csv", table, delimiter=",", header=head, comments="")
    (tmp_path / "study.yaml").write_text(f"""name: shaft
channels: [{{name: n, unit: {unit}, sd: 0.5}}]
commands: [{{name: u, unit: V}}]
runs: [{{name: a}}, {{name: b}}]
model:
  system: ode
  inputs: [{{name: u, held: true}}]
  states: {{q: 0, w: 0}}
  parameters: {{J: {{value: 0.05, percent: 5}}, d: {{value: 0.08, percent: 10}}}}
  rates: {{q: w, w: (u - d*w)/J}}
  readings: {{n: {read}}}
  places: [{{name: shaft, position: q, velocity: w, inertia: J, unit: N m}}]
""")
    study = load_study(tmp_path)
    problems = list(column_problems(study, setup_of(study)))
    assert [p.where for p in problems] == (["channel n"] if said else []), problems
    assert not said or "`unit: rpm`" in problems[0].message
