"""What drives and cameras do to a rod that is recorded in time is found; poses do without."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Run, Study
from diffsim.identify import fit
from diffsim.systems.registry import setup_of
from tests.systems.rod.test_rod_description import MODEL, NOISE, plain_study

TIME = np.arange(0.0, 4.0, 0.2)
SWING = 1.5 - 1.5 * np.cos(2.0 * np.pi * TIME / 2.0)  # two pulls


def pulled(**keys):
    """One tendon is pulled twice, then the other; a camera sees the middle, a tracker the tip."""
    names = [(m, a) for m in ("middle", "tip") for a in "xyz"]
    channels = tuple(
        Channel(f"{m}_{a}", "m", "position", NOISE, None, {"middle": "camera"}.get(m, "tracker"))
        for m, a in names
    )
    still = np.zeros_like(SWING)
    pulls = ({"left": SWING, "right": still}, {"left": still, "right": 0.8 * SWING})
    runs = tuple(
        Run(f"pull_{k}", TIME, np.zeros((len(TIME), 6)), pull, f"g{k}", k)
        for k, pull in enumerate(pulls)
    )
    model = {k: v for k, v in MODEL.items() if k != "sessions"}
    return Study("arm", "rod", channels, runs, model={**model, "samples": "time", **keys})


def with_hidden(name, size):
    """The study as it would be recorded with a cause."""
    made = pulled()
    setup = setup_of(made)
    cause = next(e for e in setup.effects if e.name == name)
    rng = np.random.default_rng(0)
    at = {cause: torch.tensor([size], dtype=torch.float64)}
    with torch.no_grad():
        shown = [setup.model.predict(r, setup.model.at_prior(), at).numpy() for r in made.runs]
    runs = [
        replace(r, measured=y + NOISE * rng.normal(size=y.shape))
        for r, y in zip(made.runs, shown, strict=True)
    ]
    return replace(made, runs=tuple(runs))


# a play and a clock, whose maps no formula writes; those of formulas: tests/systems/kinds.py
HIDDEN = {"backlash": 0.2, "sensor_delay_of_camera": 0.12}


@pytest.mark.parametrize("name", HIDDEN)
def test_what_drives_and_sensors_do_in_time_is_fitted_to_its_size(name):
    made = with_hidden(name, HIDDEN[name])
    setup = setup_of(made)
    cause = next(e for e in setup.effects if e.name == name)
    plain = fit(setup.model, made.fit_runs, made.channels)
    found = fit(setup.model, made.fit_runs, made.channels, effects=[cause])
    assert found.values[name] == pytest.approx(HIDDEN[name], rel=0.1)
    assert found.chi2 < 0.5 * plain.chi2


def test_a_lag_is_what_a_filter_of_the_tension_makes():
    """The pose follows the tension at once: a lag of 0.1 s is that of the tension itself."""
    setup = setup_of(pulled())
    lag = next(e for e in setup.effects if e.name == "lag")
    size = torch.tensor([0.1], dtype=torch.float64)
    run = pulled().runs[0]
    rate, late = np.diff(SWING) / np.diff(TIME), [0.0]
    for before, after, slope, step in zip(SWING, SWING[1:], rate, np.diff(TIME), strict=False):
        rest = late[-1] - (before - 0.1 * slope)  # from the straight line that it tends to
        late.append(after - 0.1 * slope + rest * np.exp(-step / 0.1))
    slow = replace(run, command={**run.command, "left": np.array(late)})
    q = setup.model.at_prior()
    with torch.no_grad():
        lagged = setup.model.predict(run, q, {lag: size})
        torch.testing.assert_close(lagged, setup.model.predict(slow, q), atol=1e-8, rtol=0.0)
        assert float((lagged - setup.model.predict(run, q)).abs().max()) > 1e-3


def test_poses_have_no_causes_in_time_and_few_of_signals():
    made = plain_study()
    names = {e.name for e in setup_of(made).effects}
    assert "command_gain" in names
    assert not names & {"lag", "delay", "backlash", "saturation", "sensor_scale"}
    asked = {**MODEL, "effects": {"only": ["drive_loss", "saturation", "sensor_scale"]}}
    known = {e.name for e in setup_of(replace(made, model=asked)).effects}
    assert known == {"drive_loss", "saturation", "sensor_scale"}
    with pytest.raises(ValueError, match="no cause 'lag'"):
        setup_of(replace(made, model={**MODEL, "effects": {"only": ["lag"]}}))
