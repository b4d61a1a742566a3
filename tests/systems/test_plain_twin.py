"""A sensor that shows several times too much, and the data sheet that would do the same."""

import numpy as np
import pytest

from diffsim.core.figures import figure
from diffsim.data.study import Channel, Command, Run, Study
from diffsim.diagnose import diagnose
from diffsim.systems import setup_of

TIME = 0.01 * np.arange(120.0)


def spring_study(gain: float, offset: float) -> Study:
    """Stretch of a spring of 100 N/m, pulled by ``gain`` times the command and ``offset`` [N]."""
    rng = np.random.default_rng(3)
    runs = []
    for k, (name, use) in enumerate(zip("abcd", ["fit", "fit", "select", "test"], strict=True)):
        force = (1.0 + 0.3 * k) * np.sin((3.0 + k) * TIME)
        seen = (gain * force + offset) / 100.0 + 1e-4 * rng.standard_normal(len(TIME))
        runs.append(Run(name, TIME, seen[:, None], {"force": force}, name, k, use))
    model = {
        "system": "bench",
        "parameters": {"stiffness": {"value": "100 N/m", "percent": 2}},
        "readings": {"stretch": "force/stiffness"},
    }
    channels = (Channel("stretch", "m", "position", sd=1e-4),)
    commands = (Command("force", unit="N"),)
    return Study("spring", "bench", channels, tuple(runs), commands=commands, model=model)


def answer(gain, offset, name):
    study = spring_study(gain, offset)
    setup = setup_of(study)
    effects = [effect for effect in setup.effects if effect.name == name]
    return diagnose(study, setup.model, effects, seed=0, settings=setup.settings)


@pytest.mark.parametrize("gain", [4.0, 0.25])
def test_a_gain_is_said_with_the_data_sheet_that_does_the_same(gain):
    report = answer(gain, 0.0, "sensor_scale")
    assert report.named == ("sensor_scale",)
    (twin,) = report.plain_twin
    assert twin.name == "stiffness"
    times = twin.value / twin.prior_value
    assert times == pytest.approx(1.0 / gain, rel=0.05)  # its data sheet holds it back
    said = f"ithout it the model fits as well, with stiffness at {figure(times)} times its data"
    assert (said in report.headline) == (report.causes[0].status == "likely")
    assert said in " ".join(report.sentences)
    assert report.to_dict()["plain_twin"][0]["name"] == "stiffness"


def test_no_twin_is_said_of_what_no_data_sheet_does():
    report = answer(1.0, 0.5, "sensor_offset_of_position")
    assert report.named == ("sensor_offset_of_position",)
    assert report.plain_twin == ()
    assert "fits as well" not in report.headline
