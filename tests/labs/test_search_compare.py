"""Two versions on the same cases: what counts as right, and how their rows stand side by side."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from diffsim.diagnose import diagnose
from diffsim.systems import setup_of
from labs.search_compare.__main__ import compared, scored
from labs.search_compare.cars import CARS
from labs.search_compare.rigs import RIGS

TRUTH = frozenset({"delay"})
PAIR = frozenset({"lag", "delay"})


def report(verdict, named=(), rivals=(), best=None):
    errors = (SimpleNamespace(after=2.0, noise=1.0),)
    return SimpleNamespace(
        verdict=verdict, named=named, rivals=rivals, best_names=best or named, errors=errors
    )


@pytest.mark.parametrize(
    ("given", "truth", "is_right", "is_open", "num_false"),
    [
        (report("named", ("delay_of_u0", "delay_of_u1")), TRUTH, True, False, 0),
        (report("named", ("delay", "lag")), TRUTH, False, False, 1),
        (report("ambiguous", ("lag",), (("delay_of_u0",),)), TRUTH, False, True, 0),
        (report("ambiguous", ("lag",), (("slack",),)), TRUTH, False, False, 0),
        (report("ambiguous", best=("delay_of_u0",), rivals=(("lag",),)), TRUTH, False, True, 0),
        (report("unknown"), TRUTH, False, True, 0),
        (report("none"), TRUTH, False, False, 0),
        (report("none"), frozenset(), True, False, 0),
        (report("named", ("lag",)), frozenset(), False, False, 1),
        (report("named", ("lag",), (("lag", "delay"),), ("lag", "gain")), PAIR, False, True, 0),
    ],
)
def test_outcomes_are_by_rows_whatever_the_place(given, truth, is_right, is_open, num_false):
    row = scored(given, truth)
    assert (row["right"], row["open"], row["false"]) == (is_right, is_open, num_false)
    assert row["error"] == 2.0


def test_two_runs_stand_side_by_side(tmp_path):
    row = {"kind": "tanks", "open": False, "false": 1, "error": 3.0, "cpu_s": 2.0}
    for version, is_right, count in (("a", False, 10), ("b", True, 7)):
        made = {**row, "right": is_right, "simulations": count}
        (tmp_path / version).mkdir()
        (tmp_path / version / "tanks_0.json").write_text(json.dumps({"result": made}))
    (tmp_path / "b" / "tanks_1.json").write_text(json.dumps({"result": row}))
    text = compared(tmp_path / "a", tmp_path / "b")
    assert (
        "| tanks (1) | 0 / 1 | 0 / 0 | 1 / 0 | 1 / 1 | 3.00 sd / 3.00 sd | 10 / 7 | 2 / 2 |" in text
    )


def test_the_upper_tank_of_the_first_run_never_spills():
    """Else no run would tell what the plain model is."""
    study = RIGS["tanks"].record(0, False)
    assert study.runs[0].measured.max() < study.runs[2].measured.max()
    assert np.isfinite([run.measured.max() for run in study.runs]).all()
    assert [run.use for run in study.runs] == [*["fit"] * 4, "test"]


@pytest.mark.cpu(10)
def test_a_delay_of_several_samples_is_no_lag_with_something_beside():
    """Slopes at zero promise a lag, of which two further causes make up for the shape."""
    study = CARS["car_that_grips"].record(0, False)
    setup = setup_of(study)
    report = diagnose(study, setup.model, setup.effects, seed=0)
    assert report.named == ("delay_of_steer",)
    assert max(row.after / row.noise for row in report.errors) < 1.2
