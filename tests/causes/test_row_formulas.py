"""What formulas of rows may name: other channels, columns, facts, memories, further numbers."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.systems.registry import setup_of
from tests.causes.test_own_rows import with_rows
from tests.diagnose.discover.pump_rig import STEP, heated, recorded
from tests.systems.outside import scenes

SIZE = 0.3


def study():
    made = recorded(uses=("fit", "fit"), count=30)
    return replace(made, model={k: v for k, v in made.model.items() if k != "effects"})


def predicted(given, row, size, shift=0.0):
    """Plain and changed record of the second run; further numbers a standard deviation off."""
    made = setup_of(with_rows(given, {"name": "mine", "typical": 0.1, **row}))
    effect = next(e for e in made.effects if e.name == "mine")
    run, q = given.runs[1], made.model.at_prior()
    for k, parameter in enumerate(made.model.base):
        q[k] = shift if parameter.name in effect.shapes else 0.0
    sizes = {effect: torch.tensor([size], dtype=torch.float64)}
    both = [made.model.predict(run, q, s).detach().numpy() for s in ({}, sizes)]
    return run, *both


ON_READINGS = {
    "another channel": ("u + size*p_b", lambda run, p: p[:, 1]),
    "a column": ("u + size*(temperature - 298)", lambda run, p: run.columns["temperature"] - 298.0),
    "a command": ("u + size*1e9*pump_b", lambda run, p: 1e9 * run.command["pump_b"]),
    "a fact": ("u + size*day_temperature", lambda run, p: run.setup["day_temperature"]),
    "a mean": ("u + size*mean_of_temperature", lambda run, p: run.columns["temperature"].mean()),
    "the order": ("u + size*run_order", lambda run, p: run.order),
}


@pytest.mark.parametrize("what", ON_READINGS)
def test_a_reading_is_changed_by(what):
    text, more = ON_READINGS[what]
    run, plain, changed = predicted(study(), {"at": "reading", "of": "p_a", "map": text}, SIZE)
    np.testing.assert_allclose(changed[:, 0], plain[:, 0] + SIZE * more(run, plain), rtol=1e-12)
    np.testing.assert_array_equal(changed[:, 1], plain[:, 1])


@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_a_memory_follows_with_its_time(shift):
    """Heat of a square, by small steps; its time is a base parameter 4 s to 4.8 s long."""
    row = {
        "at": "reading",
        "of": "p_a",
        "map": "u + size*warm",
        "memories": {"warm": {"of": "(1e9*pump_a)**2", "lasts": "tau", "start": "zero"}},
        "shapes": {"tau": {"value": 4.0, "sd": 0.8, "unit": "s"}},
    }
    run, plain, changed = predicted(study(), row, SIZE, shift)
    want = heated((1e9 * run.command["pump_a"]) ** 2, 4.0 + 0.8 * shift)
    assert run.time_s[1] == STEP
    np.testing.assert_allclose(changed[:, 0] - plain[:, 0], SIZE * want, rtol=0.01, atol=1e-3)


def test_a_number_grows_with_a_fact():
    row = {"at": "number", "scale": "resistance_c", "map": "size*(day_temperature - 300)"}
    run, plain, changed = predicted(study(), row, 0.01)
    flow = run.command["pump_a"] + run.command["pump_b"]
    more = 2e11 * flow * 0.01 * (run.setup["day_temperature"] - 300.0)
    np.testing.assert_allclose(changed - plain, np.stack([more, more], 1), rtol=1e-9)


def test_a_force_has_further_numbers_and_facts():
    """A spring that begins at a place, as the table of forces would write it with a number."""
    given = scenes.recorded()
    given = replace(given, runs=tuple(replace(r, setup={"gap": 0.1}) for r in given.runs))
    with_shape = {"law": "-size*max(x - start, 0)", "shapes": {"start": {"value": 0.0, "sd": 0.1}}}
    records = [
        predicted(given, {"at": "force", "of": "hinge", **row}, SIZE, 1.0)[2]
        for row in (with_shape, {"law": "-size*max(x - gap, 0)"}, {"law": "-size*max(x - 0.1, 0)"})
    ]
    for record in records[:2]:
        np.testing.assert_allclose(record, records[2], rtol=1e-12)
    assert (
        np.abs(
            records[0] - predicted(given, {"at": "force", "of": "hinge", "law": "size*0"}, 0.0)[1]
        ).max()
        > 1e-3
    )


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ({"at": "reading", "map": "u + size*temprature"}, "did you mean 'temperature'"),
        ({"at": "command", "map": "u + size*p_b"}, "'p_b' is not known here"),
        ({"at": "number", "scale": "viscosity", "map": "size*temperature"}, "not known here"),
        ({"at": "reading", "map": "lagged", "shapes": {"a": {"value": 1}}}, "write one under map"),
        (
            {"at": "reading", "map": "u + size*m", "memories": {"m": {"of": "u", "lasts": "2*3"}}},
            None,
        ),
    ],
)
def test_what_a_formula_cannot_name_is_refused(row, said):
    given = {"name": "mine", "typical": 0.1, **row}
    if said is None:
        given["memories"] = {"m": {"of": "u", "lasts": "long"}}
        said = "'long' is not known here"
    with pytest.raises(ValueError, match=said):
        setup_of(with_rows(study(), given))
