"""A quadcopter with a rotor that gives too little thrust, and its extended model."""

from pathlib import Path

import numpy as np

from diffsim.data.study import Study
from diffsim.identify import fit
from diffsim.identify.model_file import save_extended
from diffsim.sim_to_real import Tracking
from diffsim.systems import setup_of
from tests.systems import small_copter
from tests.systems.small_copter import Causes
from tests.systems.test_multicopter_description import SPEEDS, study

WEAK = Causes(shares=(1.0, 0.9, 1.0, 1.0))
HOVER = float(np.sqrt(small_copter.MASS * small_copter.GRAVITY / 4 / small_copter.COEFFICIENT))
SENSORS = {
    "position": ["x", "y", "z"],
    "roll_pitch_yaw": ["roll", "pitch", "yaw"],
    "body_rates": ["p", "q", "r"],
}
TASK = Tracking(
    seconds=0.8,
    every=0.02,
    knots=6,
    commands={n: {"least": 0.7 * HOVER, "most": 1.3 * HOVER, "rest": HOVER} for n in SPEEDS},
    start={"z": 1.0},
    wanted={
        "x": {"course": "0.2*(1 - cos(pi*t/0.8))/2", "miss": 0.01},
        "y": {"course": "0", "miss": 0.01},
        "z": {"course": "1 + 0.2*(1 - cos(pi*t/0.8))/2", "miss": 0.01},
    },
)


def fitted_copter(folder: Path) -> Study:
    """Study of one recorded flight; its extended model is written to a folder."""
    made = study(
        causes=WEAK,
        kinds=("dash",),
        sensors=SENSORS,
        effects={"only": ["weak_rotor_2"]},
    )
    setup = setup_of(made)
    found = fit(setup.model, made.fit_runs, made.channels, effects=setup.effects)
    plain = fit(setup.model, made.fit_runs, made.channels)
    save_extended(found, folder / "extended_model.yaml", study=made, verdict="named", plain=plain)
    return made


def fly_open_loop(commands: np.ndarray, dt: float, height: float = 1.0) -> np.ndarray:
    """Places of the real copter, (num_samples, 3) [m], under speeds (num_samples, 4) held between.

    It starts at rest one sample before the first, under the first speeds.
    """
    state = np.zeros(26)
    state[2], state[6:15] = height, np.eye(3).ravel()
    places, fine = [], 10
    for command in np.concatenate([commands[:1], commands[:-1]]):
        state[18:22] = command
        for _ in range(fine):
            h = dt / fine
            a = small_copter._rate(state, command, WEAK, 0.0)
            b = small_copter._rate(state + 0.5 * h * a, command, WEAK, 0.0)
            c = small_copter._rate(state + 0.5 * h * b, command, WEAK, 0.0)
            d = small_copter._rate(state + h * c, command, WEAK, 0.0)
            state = state + h / 6.0 * (a + 2 * b + 2 * c + d)
        places.append(state[:3].copy())
    return np.array(places)
