"""Entries written once for a row: masses between springs, against their closed form."""

import numpy as np
import pytest

from diffsim.cli.diagnose_check import _without_use
from diffsim.data.study import Channel, Run, Study
from diffsim.systems.ode.repeat import write_out
from diffsim.systems.registry import setup_of

MASSES = 4
STIFFNESS, MASS, STEP = 30.0, 0.5, 0.01
MODEL = {
    "system": "ode",
    "repeat": {"k": MASSES},
    "time_step": 0.0025,
    "parameters": {"stiffness": STIFFNESS, "mass_{k}": [MASS] * MASSES},
    "states": {"x_{k}": [0.1, 0.0, -0.05, 0.02], "v_{k}": 0},
    "define": {
        "x_0": "0",
        f"x_{MASSES + 1}": "0",
        "force_{k}": "stiffness*(x_{k-1} - 2*x_{k} + x_{k+1})",
        "momentum_0": "0",
        "momentum_{k}": "momentum_{k-1} + mass_{k}*v_{k}",
    },
    "rates": {"x_{k}": "v_{k}", "v_{k}": "force_{k}/mass_{k}"},
    "readings": {"x{k}": "x_{k}", "momentum": f"momentum_{MASSES}"},
}


def row_of_masses() -> Study:
    t = STEP * np.arange(100)
    channels = (
        *(Channel(f"x{k}", "m", "position", 1e-3) for k in range(1, MASSES + 1)),
        Channel("momentum", "kg m/s", "momentum", 1e-3),
    )
    run = Run("a", t, np.zeros((len(t), len(channels))), {}, "a")
    return Study("row", "ode", channels, (run,), model=MODEL)


def test_a_row_of_masses_swings_as_its_modes_say():
    study = row_of_masses()
    setup = setup_of(study)
    found = setup.model.predict(study.runs[0], setup.model.at_prior(), {}).numpy()
    k = np.arange(1, MASSES + 1)
    shapes = np.sqrt(2 / (MASSES + 1)) * np.sin(np.pi * np.outer(k, k) / (MASSES + 1))
    w = 2 * np.sqrt(STIFFNESS / MASS) * np.sin(0.5 * np.pi * k / (MASSES + 1))
    start = shapes.T @ MODEL["states"]["x_{k}"]
    t = study.runs[0].time_s[:, None]
    x = (start * np.cos(w * t)) @ shapes.T
    momentum = MASS * ((-w * start * np.sin(w * t)) @ shapes.T).sum(1)
    assert np.abs(found[:, :MASSES] - x).max() < 1e-7
    assert np.abs(found[:, MASSES] - momentum).max() < 1e-6


def test_names_in_a_repeated_formula_count_as_used():
    assert list(_without_use(MODEL)) == []
    unused = {**MODEL, "parameters": {**MODEL["parameters"], "spare_{k}": 1}}
    assert len(list(_without_use(unused))) == MASSES


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"repeat": {"k": 2}, "define": {"a_{j}": "1"}}, "repeat states no 'j'"),
        ({"repeat": {"k": 2}, "define": {"a_{k}": ["1", "2", "3"]}}, "3 values, but k counts to 2"),
        ({"repeat": {"k": 0}, "define": {}}, "a number from 1 to 200"),
        ({"repeat": {"k": 2}, "define": {"a_{k}": "1", "a_2": "3"}}, "a_2 is stated twice"),
        ({"repeat": {"k": 2, "j": 2}, "define": {"a_{k}_{j}": "1"}}, "one index for each entry"),
    ],
)
def test_what_cannot_be_written_out_is_said(given, said):
    with pytest.raises(ValueError, match=said):
        write_out(given)


def test_what_is_written_out_stays_as_it_is():
    once = write_out(MODEL)
    assert write_out(once) == once
    assert once["parameters"]["mass_3"] == MASS
