"""A law that another number of the model would do nearly as well: fits decide where it is."""

import numpy as np
import pytest

from diffsim.data.study import Channel, Run, Study
from tests.diagnose.discover.test_stage import fitted_laws

GAIN, RESISTANCE, INERTIA, DAMPING, VOLTAGE = 0.06, 0.35, 2.2e-3, 4e-4, 12.4
INSIDE = 0.16  # resistance of the battery, of which a bridge sees duty squared [ohm]
MODEL = {
    "system": "ode",
    "states": {"turn": "0", "speed": "0"},
    "inputs": [{"name": "duty", "held": True}],
    "rates": {"turn": "speed", "speed": "(k*(duty*12.4 - k*speed)/R - b*speed)/J"},
    "readings": {"speed": "speed"},
    "parameters": {
        "R": {"value": RESISTANCE, "percent": 10, "unit": "ohm"},
        "k": {"value": GAIN, "percent": 8, "unit": "N m/A"},
        "J": {"value": INERTIA, "percent": 15, "unit": "kg m^2"},
        "b": {"value": DAMPING, "percent": 40, "unit": "N m s/rad"},
    },
    "places": [{"name": "axle", "position": "turn", "velocity": "speed", "inertia": "J"}],
    "effects": {"only": ["gain_slope"]},
}


def wheel(seed: int) -> Study:
    """A wheel that is driven by duty from a battery."""
    rng, time, noise = np.random.default_rng(seed), 0.02 * np.arange(150.0), 0.8
    shapes = (time % 1.6 < 0.9, np.abs(np.sin(np.pi * time)), np.minimum(time / 2.0, 1.0))
    runs = []
    for k, use in enumerate(("fit", "fit", "fit", "select", "fit", "test")):
        duty = rng.uniform(0.35, 0.95) * shapes[k % 3]
        speed, seen = 0.0, []
        for u in duty:
            seen.append(speed)
            for _ in range(20):
                current = (u * VOLTAGE - GAIN * speed) / (RESISTANCE + u**2 * INSIDE)
                speed += 1e-3 * (GAIN * current - DAMPING * speed) / INERTIA
        read = np.array(seen) + noise * rng.normal(size=len(time))
        runs.append(Run(f"r{k}", time, read[:, None], {"duty": duty}, f"r{k}", k, use))
    channels = (Channel("speed", "rad/s", "angular_velocity", noise),)
    return Study("wheel", "ode", channels, tuple(runs), model=MODEL)


@pytest.mark.story  # a whole diagnosis
def test_a_search_begins_at_each_number_whose_law_does_nearly_the_same():
    """By slopes from there the other one seems far behind: a kart's inertia was named."""
    laws = fitted_laws(wheel(2))
    places = {law.name: law.entry.target for law in laws.laws}
    assert set(places.values()) == {"R", "J"}
    assert {places[name] for begin in laws.begins for name in begin.sizes} == {"R", "J"}
