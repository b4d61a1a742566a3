"""Sand runs out of a hopper as fast when it is full as when it is not; the model knows water."""

import numpy as np
import pytest

from diffsim.data.study import Channel, Command, Run, Study
from tests.diagnose.discover.answers import found

STEP, FLOW = 0.5, 0.11  # [s], [kg/s]
TIME = STEP * np.arange(100)
MODEL = {
    "system": "ode",
    "parameters": {"k": {"value": 0.04, "percent": 30}},
    "inputs": [{"name": "valve", "held": True}],
    "states": {"mass": "first_weight"},
    "rates": {"mass": "-k*valve*sqrt(max(mass, 0.001))"},
    "readings": {"weight": "mass"},
    "effects": {"only": ["sensor_scale", "sensor_curvature", "saturation"]},
}


def batch(name, filled, period, use="fit"):
    valve = (np.sin(2.0 * np.pi * TIME / period + filled) > -0.3).astype(float)
    gone = FLOW * STEP * np.concatenate([[0.0], np.cumsum(valve[:-1])])
    noise = np.random.default_rng(int(10 * filled)).normal(0.0, 0.01, len(TIME))
    return Run(name, TIME, (filled - gone + noise)[:, None], {"valve": valve}, name, use=use)


@pytest.mark.story  # a whole diagnosis with laws; those of a plain run: test_stage, test_ports
def test_a_flow_that_does_not_know_the_level_is_a_power_of_it():
    """The flow's number falls with the root of the mass: a curve of the scale fits as well, but
    was bent by all runs."""
    runs = [batch("a", 9.1, 13.0), batch("b", 6.4, 17.0), batch("c", 7.7, 9.0)]
    runs.append(batch("d", 8.3, 11.0, use="test"))
    channels = (Channel("weight", "kg", "mass", sd=0.01),)
    study = Study("hopper", "ode", channels, tuple(runs), commands=(Command("valve"),), model=MODEL)
    report = found(study)
    law, *others = report.described.laws
    assert law.status == "certain" and {one.status for one in others} <= {"possible"}
    assert report.verdict == "described" and law.variables == ("mass",)
    assert law.entry == {"kind": "number", "target": "k"} and law.form == "power"
    size = report.causes[0].size["size"]
    assert size.low < -0.5 < size.high and size.high - size.low < 0.1
