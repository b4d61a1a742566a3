"""A vessel that leaks through a hole, whose model has none: the pressure's root at a rate."""

import numpy as np
import pytest

from diffsim.data.study import Channel, Command, Run, Study
from tests.diagnose.discover.answers import found

STEP, SUBSTEPS, NOISE = 0.2, 20, 20.0  # [s], [-], [Pa]
TIME = STEP * np.arange(150)
LEAK, VOLUME, ATMOSPHERE = 1.1e-6, 0.02, 101325.0  # [m^3/s/Pa^0.5], [m^3], [Pa]
MODEL = {
    "system": "ode",
    "parameters": {"volume": {"value": VOLUME, "percent": 5}},
    "inputs": [{"name": "inflow", "held": True}],
    "states": {"p": "0"},
    "rates": {"p": f"inflow*{ATMOSPHERE}/volume"},
    "readings": {"pressure": "p"},
}


def filling(name, seed, use="fit"):
    inflow = 2e-4 * (1.0 + 0.3 * seed) * (np.sin(2.0 * np.pi * (0.05 + 0.02 * seed) * TIME) > 0.0)
    p, seen = 0.0, []
    for flow in inflow:
        seen.append(p)
        for _ in range(SUBSTEPS):
            leak = LEAK * np.sqrt(max(p, 0.0))
            p += STEP / SUBSTEPS * (flow - leak) * ATMOSPHERE / VOLUME
    noise = np.random.default_rng(seed).normal(0.0, NOISE, len(TIME))
    return Run(name, TIME, (np.array(seen) + noise)[:, None], {"inflow": inflow}, name, use=use)


@pytest.mark.story  # a whole diagnosis with laws; those of a plain run: test_stage, test_ports
def test_a_leak_is_the_root_of_the_pressure_though_the_plain_fit_left_its_sheet():
    """The plain fit triples the volume; a noisy pressure goes through zero. Neither hides it."""
    runs = [filling("a", 0), filling("b", 1), filling("c", 2, "select"), filling("d", 3, "test")]
    channels = (Channel("pressure", "Pa", "pressure", sd=NOISE),)
    commands = (Command("inflow", unit="m^3/s"),)
    study = Study("vessel", "ode", channels, tuple(runs), commands=commands, model=MODEL)
    report = found(study)
    law = report.described.laws[0]
    assert report.verdict == "described" and law.entry == {"kind": "rate", "target": "p"}
    assert law.variables == ("p",) and law.form == "power"
    root = report.best.values[f"exponent_of_{law.name}"]
    assert root == pytest.approx(0.5, abs=0.02)
    rate = LEAK * ATMOSPHERE / VOLUME
    assert -report.best.values[law.name] == pytest.approx(rate, rel=0.15)
    (error,) = report.errors
    assert error.after < 1.2 * NOISE < 0.05 * error.before
