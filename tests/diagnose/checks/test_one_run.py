"""A slip of one run is told by the others, whatever the run is used for; a cause is none."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.cli.diagnose_inputs import inputs_of
from diffsim.data.record import record_findings
from diffsim.data.study_file import load_study
from diffsim.diagnose.checks.one_run import run_problems
from diffsim.diagnose.diagnosis import diagnosed
from diffsim.systems.registry import setup_of
from labs.records.damages import doubled_rows
from labs.records.rigs import joint, stage, wheel
from tests.diagnose.discover.answers import few_laws

LATE = 30  # rows
ROWS = 250  # of 500: a search takes half as long


def _problems(folder, room):
    study = load_study(folder.write(room))
    return [*run_problems(study, setup_of(study))]


def _late(values, rows=LATE):
    return np.concatenate([np.full(rows, values[0]), values[:-rows]])


SLIPS = {
    "sign": (lambda t: {"speed_rad_s": -t["speed_rad_s"]}, "channel seen with a turned sign"),
    "unit": (lambda t: {"speed_rad_s": t["speed_rad_s"] / 60.0}, "by 60 (minutes)"),
    "command": (lambda t: {"voltage_V": 1e3 * t["voltage_V"]}, "by a thousand"),
    "clock": (lambda t: {"speed_rad_s": _late(t["speed_rad_s"])}, "s late"),
}


@pytest.mark.parametrize(
    ("slip", "run"),
    [(slip, "d") for slip in SLIPS] + [("sign", "b"), ("command", "b"), ("clock", "e")],
)
def test_a_slip_of_one_run_is_told_whatever_its_use(slip, run, tmp_path):
    change, said = SLIPS[slip]
    rig = wheel(np.random.default_rng(8))
    damaged = rig.changed({**rig.tables, run: {**rig.tables[run], **change(rig.tables[run])}})
    (problem,) = _problems(damaged, tmp_path / "rig")
    assert problem.where == f"run {run}" and said in problem.message, problem.message


@pytest.mark.parametrize(
    "change",
    [
        lambda t: {},
        lambda t: {"speed_rad_s": _late(t["speed_rad_s"], 12)},
        lambda t: {"speed_rad_s": np.clip(t["speed_rad_s"], -25.0, 25.0)},
        lambda t: {"speed_rad_s": 1.3 * t["speed_rad_s"]},
    ],
    ids=["nothing", "delay", "saturation", "gain"],
)
def test_what_all_runs_have_is_a_cause_and_no_slip(change, tmp_path):
    rig = wheel(np.random.default_rng(8))
    tables = {run: {**t, **change(t)} for run, t in rig.tables.items()}
    assert _problems(rig.changed(tables), tmp_path / "rig") == []


def test_columns_that_one_run_exchanges_are_told(tmp_path):
    rig = stage(np.random.default_rng(3))
    first, second = (c["column"] for c in rig.study["channels"][:2])
    t = rig.tables["c"]
    damaged = rig.changed({**rig.tables, "c": {**t, first: t[second], second: t[first]}})
    (problem,) = _problems(damaged, tmp_path / "rig")
    assert problem.where == "run c" and "are exchanged" in problem.message


@pytest.mark.parametrize("seed", range(4))
def test_rows_that_were_written_twice_are_told_by_the_record(seed, tmp_path):
    rng = np.random.default_rng(seed)
    sound = joint(rng)
    assert not any(
        f.rule == "doubled" for f in record_findings(load_study(sound.write(tmp_path / "s")))
    )
    found = record_findings(load_study(doubled_rows(sound, rng).write(tmp_path / "d")))
    assert [f.rule for f in found if f.stops] == ["doubled"]


@pytest.mark.story  # a whole first answer, laws looked for in vain
@pytest.mark.parametrize("run", ["b", "d"], ids=["fit", "select"])
def test_a_run_that_contradicts_the_others_leaves_nothing_unsaid(run, tmp_path):
    """Its sensor, or the machine, stands still from the middle on: no slip that can be mended."""
    rng = np.random.default_rng(8)
    rig = wheel(rng)
    tables = {name: {k: v[:ROWS] for k, v in t.items()} for name, t in rig.tables.items()}
    speed = tables[run]["speed_rad_s"].copy()
    half = len(speed) // 2
    speed[half:] = speed[half] + rng.normal(0.0, 0.3, len(speed) - half)
    damaged = rig.changed({**tables, run: {**tables[run], "speed_rad_s": speed}})
    study = load_study(damaged.write(tmp_path / "rig"))
    few = {"only": ["lag", "command_gain"]}
    study = replace(study, model={**study.model, "effects": few})
    with few_laws():
        report = diagnosed(inputs_of(study, seed=0, budget="quick"))
    assert report.verdict == "unknown"
    assert report.headline.startswith(f"Run {run} contradicts the others, which leave noise alone")
    assert "read its record first" in report.sentences[0]
