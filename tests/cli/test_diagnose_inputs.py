"""A first answer of many short runs is fitted to some of them, of all kinds alike."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from diffsim.cli.diagnose_inputs import LEAST_RUNS, inputs_of, read_study

TIME = 0.02 * np.arange(40)
KINDS = ("step", "sine", "ramp")


def campaign(folder: Path, num: int, step: float) -> Path:
    """Carts that are pushed: each run twice, of three kinds, each with a start of its own."""
    runs = []
    for k in range(num):
        rows = np.column_stack([TIME, np.sin((1 + k // 2) * TIME), np.full(len(TIME), 1.0)])
        np.savetxt(folder / f"r{k}.csv", rows, delimiter=",", header="t,x,force", comments="")
        use = {num - 1: "test", num - 2: "test"}.get(k, "fit")
        entry = {"name": f"r{k}", "file": f"r{k}.csv", "use": use}
        entry["setup"] = {"kind": KINDS[(k // 2) % 3]}
        runs.append(entry | ({"repeat_of": f"r{k - 1}"} if k % 2 else {}))
    model = {
        "system": "ode",
        "states": {"x": "x0", "v": 0},
        "inputs": [{"name": "force", "held": True}],
        "parameters": {
            "mass": {"value": "1.5 kg", "percent": 10},
            "x0": {"value": 0.0, "sd": 0.1, "unit": "m", "per": "run"},
        },
        "rates": {"x": "v", "v": "force / mass"},
        "readings": {"x": "x"},
        "places": [{"name": "cart", "position": "x", "velocity": "v", "inertia": "mass"}],
        "time_step": step,
    }
    study = {
        "name": "campaign",
        "time": {"column": "t", "unit": "s"},
        "channels": [{"name": "x", "unit": "m", "sd": 0.01}],
        "commands": [{"name": "force", "unit": "N"}],
        "runs": runs,
        "model": model,
    }
    (folder / "study.yaml").write_text(yaml.safe_dump(study), encoding="utf-8")
    return folder


@pytest.mark.parametrize(("budget", "step"), [("full", 1e-4), ("quick", 1e-2)])
def test_all_runs_are_fitted_where_they_can_be(tmp_path, budget, step):
    study = read_study(str(campaign(tmp_path, 38, step)))
    inputs = inputs_of(study, seed=0, budget=budget)
    assert [run.name for run in inputs.study.runs] == [run.name for run in study.runs]
    assert not inputs.study.mended


def test_a_first_answer_fits_some_runs_of_each_kind_with_their_repeats(tmp_path):
    """A servo's 50 runs of 3 s: one fit took 42 CPU s, and the answer was cut at a quarter."""
    study = read_study(str(campaign(tmp_path, 38, 1e-4)))
    inputs = inputs_of(study, seed=0, budget="quick")
    fitted = inputs.study.fit_runs
    assert LEAST_RUNS <= len(fitted) < 20
    of_kind = Counter(run.setup["kind"] for run in fitted)
    assert set(of_kind) == set(KINDS) and max(of_kind.values()) <= 2 + min(of_kind.values())
    assert set(Counter(run.group for run in fitted).values()) == {2}
    assert inputs.study.test_runs == study.test_runs
    own = {p.name.partition("@")[2] for p in inputs.setup.model.base if "@" in p.name}
    assert own == {run.name for run in inputs.study.runs}
    assert inputs.study.mended == (  # the page says it as well
        f"{36 - len(fitted)} of 36 runs to be fitted are left out of a first answer: slopes along "
        "all causes would cost too much of it; --budget full fits all",
    )


@pytest.mark.parametrize("fact", ["icy", pytest.param(3.0, marks=pytest.mark.story)])
def test_the_only_run_of_a_kind_is_fitted(tmp_path, fact):
    """Spread evenly over runs, a first answer left out a load, a floor, that one run alone has."""
    study = read_study(str(campaign(tmp_path, 38, 1e-4)))
    runs = [
        replace(run, setup={"floor": fact if run.group == "r4" else 1.0, "day": run.order})
        for run in study.runs
    ]
    fitted = inputs_of(replace(study, runs=tuple(runs)), seed=0, budget="quick").study.fit_runs
    assert LEAST_RUNS <= len(fitted) < 20
    assert Counter(run.setup["floor"] for run in fitted)[fact] == 2


def test_all_runs_are_fitted_where_few_causes_are_asked_for(tmp_path):
    study = read_study(str(campaign(tmp_path, 38, 1.5e-4)))
    made = [
        inputs_of(study, seed=0, budget="quick", only=only).study.fit_runs
        for only in (("added_spring",), ())
    ]
    assert len(made[0]) == 36 > len(made[1])
