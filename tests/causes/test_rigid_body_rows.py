"""Bodies in free flight, seen by a camera and a radar: one of them is late, lags or is off."""

import numpy as np
import pytest

from diffsim.data.study import Channel, Run, Study
from diffsim.identify import fit
from diffsim.systems.registry import setup_of

GRAVITY, PLACE_SD, SPEED_SD = 9.81, 2e-4, 5e-3
TIME = np.arange(0.0, 0.5, 1.0 / 120.0)
BODIES = {"ball": {"sphere": "40 mm"}, "box": {"box": ["50 mm"]}}


def parabola(start, speed, time):
    """Place (num_samples, 3) and velocity upwards (num_samples,) without air."""
    fall = np.array([0.0, 0.0, -GRAVITY])
    place = start + speed * time[:, None] + 0.5 * fall * time[:, None] ** 2
    return place, speed[2] - GRAVITY * time


def study_of(body, late=0.0, scale=0.0, **keys):
    """Three throws; the radar shows the speed ``late`` [s], and larger by ``scale``."""
    rng = np.random.default_rng(4)
    runs = []
    for k in range(3):
        start, speed = rng.uniform(0.5, 1.0, 3), rng.uniform(0.5, 2.0, 3)
        place, _ = parabola(start, speed, TIME)
        _, up = parabola(start, speed, TIME - late)
        shown = np.column_stack([place, (1.0 + scale) * up])
        shown = shown + rng.normal(size=shown.shape) * np.array([PLACE_SD] * 3 + [SPEED_SD])
        runs.append(Run(f"throw_{k}", TIME, shown, {}, f"g{k}", k))
    channels = (
        *(Channel(a, "m", "position", PLACE_SD, None, "camera") for a in "xyz"),
        Channel("vz", "m/s", "velocity", SPEED_SD, None, "radar"),
    )
    model = {
        "system": "rigid_body",
        "ground": None,
        "bodies": [{"name": "body", "mass": "50 g", **BODIES[body]}],
        "measures": [
            {"body": "body", "position": {a: a for a in "xyz"}},
            {"body": "body", "velocity": {"z": "vz"}},
        ],
        **keys,
    }
    return Study("thrown", "rigid_body", channels, tuple(runs), model=model)


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize(
    ("hidden", "cause", "size"),
    [
        ({"late": 0.012}, "sensor_delay_of_radar", 0.012),
        ({"scale": 0.05}, "sensor_scale_of_radar", 0.05),
    ],
)
def test_a_sensor_that_is_late_or_off_beside_another_is_found(body, hidden, cause, size):
    made = study_of(body, **hidden)
    setup = setup_of(made)
    effect = next(e for e in setup.effects if e.name == cause)
    runs = (setup.study or made).runs
    plain = fit(setup.model, runs, made.channels)
    found = fit(setup.model, runs, made.channels, effects=[effect])
    assert found.values[cause] == pytest.approx(size, rel=0.1)
    assert found.chi2 < 0.5 * plain.chi2
    assert found.chi2 / (4 * 3 * len(TIME)) == pytest.approx(1.0, abs=0.15)


def test_a_study_that_names_no_sensor_has_none_of_their_causes():
    made = study_of("ball")
    plain = tuple(Channel(c.name, c.unit, c.kind, c.sd) for c in made.channels)
    names = {e.name for e in setup_of(Study(**{**vars(made), "channels": plain})).effects}
    assert not [n for n in names if n.startswith("sensor_")]
