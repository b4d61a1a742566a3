"""Pumps, gauges and meters of a network that is recorded in time; levels do without."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Run, Study
from diffsim.identify import fit
from diffsim.systems.registry import setup_of
from tests.systems.test_flow_description import ONE

PRESSURE_SD, FLOW_SD = 0.5, 1e-11
TIME = np.arange(0.0, 12.0, 0.1)
MOST = 2e-8  # m^3/s
RATE = 2.0 * np.pi / 4.0
MODEL = {
    **ONE,
    "samples": "time",
    "sources": [{"node": "in", "flow": "pump"}, {"node": "out", "pressure": 0}],
    "meters": [{"channel": "p", "pressure_at": "in"}, {"channel": "q", "flow_in": "a"}],
}


def flow(time):
    """What the pump is told: it swings, after a rest."""
    return np.where(time > 0.0, 0.5 * MOST * (1.0 - np.cos(RATE * time)), 0.0)


def lagged_flow(time, tau):
    """The same behind a first-order lag, in closed form."""
    share = 1.0 / (1.0 + (RATE * tau) ** 2)
    swing = share * (np.cos(RATE * time) + RATE * tau * np.sin(RATE * time))
    return 0.5 * MOST * (1.0 - swing + (share - 1.0) * np.exp(-time / tau))


def study_of(pressure=None, rate=None, **keys):
    """A channel with a pump; a gauge shows the pressure, a meter the flow."""
    channels = (
        Channel("p", "Pa", "pressure", PRESSURE_SD, None, "gauge"),
        Channel("q", "m^3/s", "flow", FLOW_SD, None, "meter"),
    )
    flows = {"pump": flow(TIME)}
    shown = np.zeros((len(TIME), 2))
    run = Run("swing", TIME, shown, flows, "g")
    made = Study("s", "flow_network", channels, (run,), model={**MODEL, **keys})
    if pressure is None or rate is None:
        return made
    model = setup_of(made).model
    with torch.no_grad():
        at_most = model.predict(
            replace(run, command={"pump": np.full(len(TIME), MOST)}), model.at_prior()
        )
    resistance = float(at_most[0, 0]) / MOST
    noise = np.random.default_rng(1).normal(size=shown.shape) * [PRESSURE_SD, FLOW_SD]
    shown = np.column_stack([resistance * pressure, rate]) + noise
    return replace(made, runs=(replace(run, measured=shown),))


CASES = {
    "lag": (0.3, lambda s: (lagged_flow(TIME, s),) * 2),
    "delay": (0.2, lambda s: (flow(TIME - s),) * 2),
    "saturation": (0.2, lambda s: (np.minimum(flow(TIME), (1.0 - s) * MOST),) * 2),
    "sensor_delay_of_gauge": (0.15, lambda s: (flow(TIME - s), flow(TIME))),
    "sensor_lag_of_meter": (0.25, lambda s: (flow(TIME), lagged_flow(TIME, s))),
}


@pytest.mark.parametrize("name", CASES)
def test_what_pumps_and_sensors_do_in_time_is_found(name):
    size, shown = CASES[name]
    made = study_of(*shown(size))
    setup = setup_of(made)
    cause = next(e for e in setup.effects if e.name == name)
    found = fit(setup.model, made.runs, made.channels, effects=[cause])
    assert found.values[name] == pytest.approx(size, rel=0.05)
    assert found.chi2 / (2 * len(TIME)) < 2.0


def test_levels_have_no_causes_in_time_and_those_of_signals_by_name():
    made = study_of(samples="levels")
    names = {e.name for e in setup_of(made).effects}
    assert "pump_gain_1" in names
    assert not names & {"lag", "delay", "saturation", "dead_band", "sensor_curvature_of_gauge"}
    asked = {"only": ["pump_gain_1", "saturation"]}
    assert len(setup_of(study_of(samples="levels", effects=asked)).effects) == 2
    with pytest.raises(ValueError, match="no cause 'lag'"):
        setup_of(study_of(samples="levels", effects={"only": ["lag"]}))


@pytest.mark.parametrize("name", ["lag", "delay"])
def test_samples_at_one_level_have_slopes_of_their_own(name):
    """A flow that swings passes each level twice, once rising."""
    made = study_of()
    setup = setup_of(made)
    cause = next(e for e in setup.effects if e.name == name)
    run, q, h = made.runs[0], setup.model.at_prior(), 1e-5
    weights = torch.linspace(1.0, 2.0, 2 * len(TIME), dtype=torch.float64).view(-1, 2)

    def score(size):
        return (weights * setup.model.predict(run, q, {cause: size})).sum()

    leaf = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(score(leaf), leaf)
    at = [float(score(torch.full((1,), k * h, dtype=torch.float64))) for k in (0, 1, 2)]
    assert float(slope) == pytest.approx((4.0 * at[1] - at[2] - 3.0 * at[0]) / (2.0 * h), rel=1e-3)
