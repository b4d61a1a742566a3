"""Causes of soft bodies by their rows: what a body offers, and causes that are new to it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.causes import OwnRow, own_causes
from diffsim.data.study import Channel
from diffsim.identify import Numerics
from diffsim.identify.fitting import fit
from diffsim.systems.registry import setup_of
from diffsim.systems.soft_body.scene import Moment
from tests.systems.soft_body.described import BAR, TENDON, described, run_of, study_of

STEP = 0.05
T = STEP * np.arange(60)
PULL = {"pull_m": 2e-3 * (1.0 - np.cos(2.0 * T)) + 1e-3 * np.sin(5.0 * T) ** 2}
TWO = (
    Channel("tip_z_m", "m", "position", 1e-5, sensor="camera"),
    Channel("mid_z_m", "m", "position", 1e-5, sensor="laser"),
)
SEEN = {
    "markers": {"tip": [0.08, 0.005, 0.008], "mid": [0.04, 0.005, 0.008]},
    "channels": {
        "tip_z_m": {"markers": "tip", "axis": "z"},
        "mid_z_m": {"markers": "mid", "axis": "z"},
    },
}
# poses so closely that a longer stroke, which has its own, is the same body
FINE = {"motion": "quasi_static", "poses": 30, "correct_mesh": False, "tolerance": 1e-10}
SEEN["numerics"] = FINE
PULLED = study_of(TENDON, (run_of("a", T, 2, command=PULL),), TWO, **SEEN)
SWUNG = study_of(BAR, (run_of("a", 0.02 * np.arange(30), load_kg=0.01),))


def predicted(study, effect=None, size=0.0):
    model = setup_of(study).model
    sizes = {} if effect is None else {effect: torch.tensor([size], dtype=torch.float64)}
    with torch.no_grad():
        return model.predict(study.runs[0], model.at_prior(), sizes)


def own(study, **row):
    rows = [OwnRow.model_validate({"name": "mine", "typical": 0.1, **row})]
    return own_causes(rows, described(study).plant(study), study)[0]


def named(study, name):
    return next(e for e in setup_of(study).effects if e.name == name)


def test_a_force_of_a_user_pulls_at_its_marker():
    """Its power is that of the marker: -size v^2 along the axis, whatever the nodes do."""
    damper = own(SWUNG, at="force", of="tip.z", law="-size*v", typical="push/speed")
    model, run = setup_of(SWUNG).model, SWUNG.runs[0]
    values = {p.name: p.value_at(torch.zeros(()).double()) for p in model.base}
    scene = damper.apply(model.build(values, run, Numerics()), torch.tensor([3.0]).double(), run)
    rng = np.random.default_rng(0)
    x = scene.body.x_rest
    v = torch.as_tensor(rng.standard_normal(x.shape))
    force = scene.makers[-1]()(scene, Moment(x, v, 0.0, 1e-3))
    tip = scene.observe(v)[2]
    assert float((force * v).sum()) == pytest.approx(-3.0 * float(tip**2), rel=1e-12)
    slower = predicted(SWUNG, damper, damper.typical)
    assert float(slower.abs().max()) < float(predicted(SWUNG).abs().max())


def test_numbers_and_places_are_those_that_the_body_has():
    ports = described(PULLED).plant(PULLED)
    assert "fiber_stiffness" in ports.numbers and "rayleigh_beta" not in ports.numbers
    assert not ports.places  # nothing moves by itself
    ports = described(SWUNG).plant(SWUNG)
    assert "rayleigh_beta" in ports.numbers and "fiber_stiffness" not in ports.numbers
    assert set(ports.places) == {"tip.x", "tip.y", "tip.z"} and not ports.commands


def test_a_late_record_is_no_second_cause_beside_a_late_command():
    pulled, swung = ({e.name: e for e in setup_of(s).effects} for s in (PULLED, SWUNG))
    assert pulled["delay"].kind == "actuator" and "sensor_delay" not in pulled
    assert swung["sensor_delay"].kind == "sensor" and "delay" not in swung
    clocked = replace(PULLED, model={**PULLED.model, "clock": {"offset": {"value": 0, "sd": 0.1}}})
    assert not {"delay", "sensor_delay"} & {e.name for e in setup_of(clocked).effects}


def test_a_saved_model_of_before_is_refused():
    old = replace(PULLED, frame={"timed": True, "reach": [0.0, 4e-3]})
    with pytest.raises(ValueError, match="the saved model has no 'scales'"):
        described(old).setup(old)


def with_play(y, half):
    """A reading behind a play, by its rule, sample after sample."""
    out = [y[0]]
    for now in y[1:]:
        out.append(min(max(out[-1], now - half), now + half))
    return np.array(out)


PLANTED = {
    "sensor_backlash_of_laser": lambda pull, y: (pull, [y[:, 0], with_play(y[:, 1], 2e-4)]),
    "command_offset": lambda pull, y: (pull + 3e-4, y.T),
    "gain_slope": lambda pull, y: (pull * (1.0 + 16.0 * np.abs(pull)), y.T),
    "delay": lambda pull, y: (np.interp(T - 0.06, T, pull), y.T),
}
SIZES = {
    "sensor_backlash_of_laser": 2e-4,
    "command_offset": 3e-4,
    "gain_slope": 16.0,
    "delay": 0.06,
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=[pytest.mark.story] * (n != "sensor_backlash_of_laser"))
        for n in PLANTED
    ],
)
def test_a_cause_that_is_new_to_soft_bodies_is_found(name):
    """Planted by NumPy in the command or in the record of the plain body."""
    change, size = PLANTED[name], SIZES[name]
    pull, _ = change(PULL["pull_m"], np.zeros((len(T), 2)))
    moved = study_of(TENDON, (run_of("a", T, 2, command={"pull_m": pull}),), TWO, **SEEN)
    _, shown = change(PULL["pull_m"], predicted(moved).numpy())
    noise = 1e-5 * np.random.default_rng(1).standard_normal((len(T), 2))
    run = replace(PULLED.runs[0], measured=np.column_stack(list(shown)) + noise)
    study = replace(PULLED, runs=(run,))
    effect = named(study, name)
    setup = setup_of(study)
    plain = fit(setup.model, study.runs, study.channels)
    found = fit(setup.model, study.runs, study.channels, effects=[effect], max_evaluations=20)
    assert found.chi2 < 1.5 * found.num_samples < plain.chi2
    assert found.values[name] == pytest.approx(size, abs=max(4.0 * found.sd[name], 0.02 * size))
    assert found.sd[name] < 0.2 * size
