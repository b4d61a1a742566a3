"""What a user calls his states and numbers changes no cause, whatever the library calls its own."""

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Run, Study
from diffsim.systems.registry import setup_of

TIME = 0.02 * np.arange(60.0)
ROLES = ("angle", "speed", "torque", "damping", "heft", "pull")
#: Letters of the library's own formulas, in no order.
LETTERS = (
    *("rate", "step", "inertia", "x", "v", "w", "u", "z", "tau", "slow", "before", "term", "after"),
    *("most", "strength", "force", "load", "hard", "loss", "usual", "low", "high", "bend"),
    *("width", "vs", "hidden", "old", "new", "blend", "more", "slip", "heat", "h", "ahead"),
)


def pendulum(names):
    """Predictions of a driven pendulum with each cause of its library, in the library's order."""
    angle, speed, torque, damping, heft, pull = names
    place = {"name": "hinge", "position": angle, "velocity": speed, "inertia": "0.07 + 0*J"}
    model = {
        "system": "ode",
        "states": {angle: "0.1 rad", speed: "0 rad/s"},
        "define": {pull: f"{torque} - {damping}*{speed} - {heft}*sin({angle})"},
        "rates": {angle: speed, speed: f"{pull}/(0.07 + 0*J)"},
        "inputs": [torque],
        "parameters": {
            "J": {"value": 1.0, "percent": 10, "unit": "kg m^2"},
            damping: {"value": 0.06, "percent": 50, "unit": "N m s/rad"},
            heft: {"value": 1.96, "percent": 7, "unit": "N m"},
        },
        "readings": {"seen": angle},
        "places": [{**place, "unit": "N m", "position_unit": "rad"}],
    }
    command = {torque: 0.8 * np.sin(5.0 * TIME)}
    run = Run("a", TIME, np.zeros((len(TIME), 1)), command, "a")
    study = Study("p", "ode", (Channel("seen", "rad", "angle", sd=2e-3),), (run,), model=model)
    made = setup_of(study)
    q, found = made.model.at_prior(), []
    for effect in made.effects:
        size = torch.full((len(effect.components),), effect.typical, dtype=torch.float64)
        with torch.no_grad():
            found.append(made.model.predict(run, q, {effect: size}).numpy())
    return np.array(found)


@pytest.mark.cpu(8)  # 18 systems, each with 40 causes
def test_no_letter_of_the_library_is_taken_for_a_users_name():
    """A velocity called `rate` became friction's letter of that name: 76 mrad for 0.9."""
    plain = pendulum(ROLES)
    assert len(plain) > 30 and np.ptp(plain, axis=0).max() > 0.1
    for k in range(0, len(LETTERS), 4):
        rolled = (*LETTERS[k:], *LETTERS[:k])[: len(ROLES)]
        for names in (rolled, (rolled[1], rolled[0], *rolled[2:])):
            np.testing.assert_allclose(pendulum(names), plain, rtol=1e-7, atol=1e-9)


def test_a_key_of_the_description_is_no_name():
    with pytest.raises(ValueError, match="'slow_time' has a meaning of its own"):
        pendulum((*ROLES[:4], "slow_time", "pull"))
