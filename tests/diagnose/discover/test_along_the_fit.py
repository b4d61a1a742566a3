"""Friction that no state feels: laws are weighed along the simulation as fitted."""

import numpy as np
import pytest

from diffsim.data.study import Channel, Command, Run, Study
from diffsim.diagnose.discover import stage
from diffsim.diagnose.discover.follow import follow
from diffsim.diagnose.discover.screen import screen_laws
from diffsim.diagnose.discover.stage import find_laws
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Problem
from diffsim.identify.linearization import linearization_at
from diffsim.identify.whitening import WhiteNoise
from diffsim.systems.registry import setup_of

AREA, FRICTION, MORE = 5e-4, 5.0, 1.5e-5  # [m^2], [N], of the pressure [N/Pa]
NOISE = 0.5  # [N]
LASTS = 0.1  # what tells the speed from the stroke [s]
MODEL = {
    "system": "ode",
    "states": {"seen": "0"},
    "define": {"speed": f"(stroke - seen)/{LASTS}"},
    "rates": {"seen": "speed"},
    "readings": {"force": "area*pressure + friction*tanh(speed/0.001)"},
    "inputs": [{"name": "stroke"}, {"name": "pressure"}],
    "parameters": {
        "area": {"value": AREA, "percent": 3, "unit": "m^2"},
        "friction": {"value": FRICTION, "percent": 50, "unit": "N"},
    },
    "effects": {"only": ["command_gain_of_stroke"]},
}


@pytest.fixture(scope="module")
def sealed():
    """A piston that a spindle drives to and fro, at five pressures; its seal rubs by pressure."""
    rng = np.random.default_rng(5)
    time = 0.1 * np.arange(160)
    stroke = 0.02 * np.abs((time / 7.0) % 2.0 - 1.0)
    runs = []
    for k, bar in enumerate((1.0, 2.0, 4.0, 6.0)):
        pressure = 1e5 * (bar + 0.02 * np.sin(0.7 * time + k))
        speed = np.sign(np.gradient(stroke, time))
        force = AREA * pressure + (FRICTION + MORE * pressure) * speed
        force += NOISE * rng.normal(size=len(time))
        turning = np.abs(np.gradient(stroke, time)) < 0.8 * 0.02 / 7.0
        force[turning | np.roll(turning, 1) | np.roll(turning, -1) | (time < 1.0)] = np.nan
        command = {"stroke": stroke - stroke[0], "pressure": pressure}
        runs.append(Run(f"at_{bar:g}_bar", time, force[:, None], command, f"r{k}", k, "fit"))
    channels = (Channel("force", "N", "force", NOISE),)
    commands = (Command("stroke", "m"), Command("pressure", "Pa"))
    return Study("seal", "ode", channels, tuple(runs), commands=commands, model=MODEL)


@pytest.fixture(scope="module")
def fitted(sealed):
    setup = setup_of(sealed)
    problem = Problem(setup.model, sealed.fit_runs, WhiteNoise(sealed.channels))
    return setup, gauss_newton(problem, linearization_at(problem, np.zeros(problem.num_base)))[0]


#: a change of the area that turns with the speed is friction that grows with the pressure
SAME = (("friction", "pressure"), ("area", "speed"))


def test_a_course_bends_the_way_where_nothing_pushes(fitted):
    """Led along the record the piston turns where it did not: laws promise more than is missing."""
    setup, fit = fitted
    led = screen_laws(follow(fit, setup.laws), setup.laws, lambda *said: None)
    assert led.found[0].nats > fit.chi2
    as_fitted = screen_laws(follow(fit, setup.laws, 0), setup.laws, lambda *said: None)
    assert as_fitted.found[0].nats < 0.5 * fit.chi2
    assert (as_fitted.found[0].entry.target, as_fitted.found[0].variable.name) in SAME


@pytest.mark.story  # a further law of the same kind
def test_friction_over_pressure_is_found_along_the_simulation_as_fitted(fitted, monkeypatch):
    setup, fit = fitted
    begin, fit_law, asked, ended = stage._begin, stage._fit_law, [], []
    monkeypatch.setattr(stage, "_begin", lambda *given: asked.append(given[2]) or begin(*given))
    monkeypatch.setattr(
        stage, "_fit_law", lambda *given: ended.append(fit_law(*given)) or ended[-1]
    )
    found = find_laws([fit], setup.laws, lambda *said: None)
    assert (found.laws[0].entry.target, found.laws[0].variable.name) in SAME
    forms = [law.form for law in found.laws if law.entry.target == "friction"]
    assert "line" in forms
    # most is linear here, and the plain fit far off its prior: fits end about where they are asked
    # to go, which is no step from there
    ends = [one.fit.problem.scaled(one.fit.x) for one in ended]
    off = [end[1] - place[1] for end, place in zip(ends, asked, strict=True)]
    assert abs(fit.x[1]) > 1.0
    assert np.median(np.abs(off)) < 0.3 * abs(fit.x[1])
