"""What commands were before a record: zero, where the start rests so; else their first values."""

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Command, Run, Study
from diffsim.identify import Problem, WhiteNoise
from diffsim.systems.registry import setup_of

STEP, TAU = 0.01, 0.2
TIME = STEP * np.arange(200.0)
LATE = 0.07


def shown(command, *, start="0", model=None, before=None, **sizes):
    """What x' = (u - x)/tau shows, or another model, with causes of these sizes, (num_samples,)."""
    model = model or {
        "parameters": {"tau": {"value": TAU, "percent": 5}},
        "states": {"x": start},
        "rates": {"x": "(u - x)/tau"},
        "readings": {"seen": "x"},
    }
    model = {"system": "ode", "inputs": [{"name": "u", "held": True}], **model}
    channels = tuple(
        Channel(name, "A" if name == "current" else "m", "position", sd=1e-3)
        for name in model["readings"]
    )
    values = np.broadcast_to(np.asarray(command, dtype=np.float64), TIME.shape)
    run = Run("a", TIME, np.zeros((len(TIME), len(channels))), {"u": values}, "a")
    study = Study(
        "steps",
        "ode",
        channels,
        (run,),
        commands=(Command("u", unit="V", before=before),),
        model=model,
    )
    setup = setup_of(study)
    effects = tuple(e for e in setup.effects if e.name in sizes)
    assert len(effects) == len(sizes)
    assert all(e.shown_unit == "V" for e in effects if e.unit == "command")
    problem = Problem(setup.model, (run,), WhiteNoise(channels), effects)
    scaled = [sizes[e.name] / unit for e, unit in zip(effects, problem.size_units, strict=True)]
    x = problem.standardized(np.array([*np.zeros(problem.num_base), *scaled]))
    with torch.no_grad():
        return problem.predict(run, torch.from_numpy(x)).numpy()[:, 0]


def rise(seconds):
    return 1.0 - np.exp(-np.maximum(seconds, 0.0) / TAU)


def test_a_step_with_the_first_row_comes_late():
    assert shown(1.0) == pytest.approx(rise(TIME), abs=1e-6)
    assert shown(1.0, delay=LATE) == pytest.approx(rise(TIME - LATE), abs=1e-6)


def test_a_step_with_the_first_row_is_lagged():
    """Two lags in a row, in closed form."""
    lag = 0.05
    exact = 1.0 - (TAU * np.exp(-TIME / TAU) - lag * np.exp(-TIME / lag)) / (TAU - lag)
    assert shown(1.0, lag=lag) == pytest.approx(exact, abs=0.02 * STEP / lag)


@pytest.mark.parametrize("before", [None, 0.0])
def test_a_step_with_the_first_row_is_gone_by_the_profile_of_its_drive(before):
    """Half of the way it speeds up, half it brakes; a servo's was there at once, and so its name
    was a delay beside something unknown."""
    most, fine = 20.0, 1e-4  # [1/s^2], [s]
    t = np.arange(0.0, TIME[-1] + fine, fine)
    done = np.clip(t, 0.0, 2.0 / np.sqrt(most))
    speeds_up = done < 1.0 / np.sqrt(most)
    left = 2.0 / np.sqrt(most) - done
    goal = np.where(speeds_up, 0.5 * most * done**2, 1.0 - 0.5 * most * left**2)
    place = np.zeros(len(t))
    for k in range(len(t) - 1):
        place[k + 1] = place[k] + fine * (0.5 * (goal[k] + goal[k + 1]) - place[k]) / TAU
    found = shown(1.0, before=before, acceleration_limit=1.0 / most)
    assert found == pytest.approx(np.interp(TIME, t, place), abs=2e-3)


@pytest.mark.parametrize("start", ["1", "0.5"])
def test_what_does_not_rest_at_zero_had_its_first_value(start):
    """At rest with the first value, or in motion with both: late is what it was."""
    steady = shown(1.0, start=start)
    assert shown(1.0, start=start, delay=LATE) == pytest.approx(steady, abs=1e-12)


@pytest.mark.parametrize("before", [0.0, -0.5])
def test_what_was_commanded_before_is_what_comes_late(before):
    """In motion with both, until what the study states gives way to the step."""
    late = TIME < LATE
    held = before + (0.5 - before) * np.exp(-TIME / TAU)
    at_step = before + (0.5 - before) * np.exp(-LATE / TAU)
    exact = np.where(late, held, 1.0 + (at_step - 1.0) * np.exp(-(TIME - LATE) / TAU))
    found = shown(1.0, start="0.5", before=before, delay=LATE)
    assert found == pytest.approx(exact, abs=1e-6)
    assert shown(1.0, start="0.5", before=before) == pytest.approx(
        1.0 - 0.5 * np.exp(-TIME / TAU), abs=1e-6
    )


def test_a_stated_delay_is_one_of_causes():
    model = {
        "parameters": {"tau": TAU, "u_delay": {"value": LATE, "sd": 1e-9}},
        "states": {"x": "0"},
        "rates": {"x": "(u - x)/tau"},
        "readings": {"seen": "x"},
    }
    assert shown(1.0, model=model) == pytest.approx(shown(1.0, delay=LATE), abs=1e-9)


def test_a_current_is_zero_until_its_voltage_exceeds_what_is_lost():
    """R i + loss sign(i) = u - K w, of a rotor that stands: no current below the loss."""
    resistance, loss = 2.0, 0.6
    voltage = 1.5 * np.sin(3.0 * TIME)
    model = {
        "parameters": {"R": {"value": resistance, "percent": 5}},
        "states": {"w": "0"},
        "rates": {"w": "0*current"},
        "define": {"current": "(u - 0.1*w)/R"},
        "readings": {"current": "current"},
    }
    found = shown(voltage, model=model, inverter_dead_time=loss)
    exact = np.sign(voltage) * np.maximum(np.abs(voltage) - loss, 0.0) / resistance
    assert found == pytest.approx(exact, abs=1e-9)
