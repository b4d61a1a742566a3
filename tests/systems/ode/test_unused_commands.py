"""What a study states and its model does not use explains what is left, as columns beside do."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Command, Run, Study
from diffsim.diagnose import diagnose
from diffsim.systems.registry import setup_of

SPEED = 0.35  # by which a degree speeds up the answer, 1/s


def _study(effects):
    """Three runs of a lag whose rate grows with a temperature that stands among the commands.

    Args:
        effects: Choice of causes.
    """
    rng, time = np.random.default_rng(2), np.arange(0.0, 6.0, 0.05)
    runs = []
    for k, use in enumerate(("fit", "fit", "test")):
        goal = np.sign(np.sin((2.0 + 0.4 * k) * time))
        warm = np.linspace(0.0, 3.0 - k, len(time)) + 0.5 * np.sin(0.9 * time + k)
        path, x = [], 0.0
        for i in range(len(time)):
            path.append(x)
            for _ in range(50):
                x += 0.001 * (2.0 + SPEED * warm[i]) * (goal[i] - x)
        measured = np.array(path)[:, None] + rng.normal(0.0, 0.005, (len(time), 1))
        command = {"goal": goal, "warm": warm}
        runs.append(Run("abcd"[k], time, measured, command, "abcd"[k], k, use))
    description = {
        "system": "ode",
        "states": {"x": "0"},
        "inputs": [{"name": "goal", "held": True}],
        "parameters": {"speed": {"value": 2.0, "percent": 20, "unit": "1/s"}},
        "rates": {"x": "speed*(goal - x)"},
        "readings": {"place": "x"},
        "effects": effects,
    }
    channels = (Channel("place", "m", "place", 0.005),)
    commands = (Command("goal", unit="-"), Command("warm", unit="K"))
    return Study("lag", "ode", channels, tuple(runs), commands=commands, model=description)


def test_a_command_that_the_model_does_not_use_is_a_variable_of_laws():
    study = _study({"only": ["command_gain", "sensor_scale"]})
    setup = setup_of(study)
    assert "warm" in {v.name for v in setup.laws.variables()}
    report = diagnose(
        study,
        setup.model,
        setup.effects,
        unknowns=setup.unknowns,
        settings=setup.settings,
        laws=setup.laws,
        seed=0,
    )
    assert "speed" in report.headline and "warm" in report.headline


def test_a_command_that_is_an_input_is_one_variable():
    names = [
        v.name
        for v in setup_of(_study({"only": ["command_gain", "sensor_scale"]})).laws.variables()
    ]
    assert names.count("goal") == 1


@pytest.mark.parametrize("shown", [None, np.nan])
def test_a_command_that_some_run_does_not_show_is_no_variable(shown):
    """Nothing uses it, so that nothing asks for it: `KeyError: 'warm'` in the search for laws."""
    study = _study({"only": ["command_gain"]})
    first, second, *others = study.runs
    command = {**second.command, "warm": second.command["warm"] * (shown or 1.0)}
    if shown is None:
        del command["warm"]
    study = replace(study, runs=(first, replace(second, command=command), *others))
    assert "warm" not in {v.name for v in setup_of(study).laws.variables()}


@pytest.mark.story  # a whole diagnosis
def test_causes_of_the_library_leave_room_for_laws():
    """Half of the budget is kept though the plain fit stays at its data sheet: none of 20 causes
    explains anything, and sets of them had spent all of it."""
    study = _study({})
    setup = setup_of(study)
    search = replace(setup.settings.search, refit_steps=2e6, scan_steps=2e6, law_steps=None)
    report = diagnose(
        study,
        setup.model,
        setup.effects,
        unknowns=setup.unknowns,
        settings=replace(setup.settings, search=search),
        laws=setup.laws,
        seed=0,
    )
    assert not any(gate.name == "law_budget" for gate in report.gates)
    assert "warm" in report.headline


def test_an_unused_command_is_held_as_one_that_is_used_is():
    """A cause of the user's own is driven by a valve that rests and jumps: straight lines between
    its samples would open it half a sample early."""
    time = np.arange(0.0, 20.0, 0.1)
    valve = np.where(np.arange(200) // 25 % 2, 1.0, 0.0)
    level = 0.1 * (np.cumsum(valve) - valve)  # each sample's value until the next one
    own = {"name": "leak", "adds_to": "x", "term": "size*valve", "unit": "1/s", "typical": 1.0}
    study = Study(
        "vessel",
        "ode",
        (Channel("level", "m", "level", 0.01),),
        tuple(
            Run(name, time, level[:, None], {"valve": valve}, name, k, "fit")
            for k, name in enumerate("ab")
        ),
        commands=(Command("valve", unit="-"),),
        model={
            "system": "ode",
            "states": {"x": "0"},
            "rates": {"x": "0*x"},
            "readings": {"level": "x"},
            "effects": {"only": ["leak"], "own": [own]},
        },
    )
    setup = setup_of(study)
    (leak,) = setup.effects
    told = setup.model.predict(
        study.runs[0], setup.model.at_prior(), {leak: torch.ones(1, dtype=torch.float64)}
    )
    np.testing.assert_allclose(told[:, 0].numpy(), level, atol=1e-9)
