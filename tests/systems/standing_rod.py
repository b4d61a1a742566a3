"""A rod that stands on its end, held by a torque that was recorded."""

import numpy as np

from diffsim.data.study import Channel, Run, Study

STEP, RATE, GAIN = 0.01, 6.0, 0.8  # [s], 1/s of a fall, share of the commanded torque that acts
INERTIA = 0.07  # [kg m^2]


def rod_study(motion):
    """Three recordings of 3 s, of a rod that gets less torque than is commanded.

    Args:
        motion: Its acceleration without torque in the model, a formula.
    """
    rng = np.random.default_rng(4)
    time = np.arange(0.0, 3.0, STEP)
    runs = []
    for k, use in enumerate(("fit", "fit", "test")):
        angle, speed, torques, seen = 0.05, 0.0, [], []
        phase = rng.uniform(0.0, 6.0)
        for t in time:
            torque = (
                -6.5 * angle - 1.1 * speed + 0.5 * np.sin(2.0 * np.pi * (0.5 + 0.3 * k) * t + phase)
            )
            torques.append(torque)
            seen.append((angle, speed))
            for _ in range(20):
                speed += STEP / 20 * (RATE**2 * np.sin(angle) + GAIN * torque / INERTIA)
                angle += STEP / 20 * speed
        measured = np.array(seen) + rng.normal(0.0, (0.0015, 0.01), (len(time), 2))
        runs.append(Run("abc"[k], time, measured, {"torque": np.array(torques)}, "abc"[k], k, use))
    channels = (
        Channel("angle_rad", "rad", "angle", 0.0015),
        Channel("rate", "rad/s", "speed", 0.01),
    )
    description = {
        "system": "ode",
        "states": {"angle": "first_angle_rad", "speed": "0"},
        "inputs": [{"name": "torque", "held": True}],
        "parameters": {
            "fall": {"value": RATE, "percent": 1, "unit": "1/s"},
            "inertia": {"value": INERTIA, "percent": 5, "unit": "kg m^2"},
        },
        "rates": {"angle": "speed", "speed": f"{motion} + torque/inertia"},
        "readings": {"angle_rad": "angle", "rate": "speed"},
        "places": [
            {
                "position": "angle",
                "velocity": "speed",
                "inertia": "inertia",
                "unit": "N m",
                "position_unit": "rad",
            }
        ],
        "effects": {"only": ["command_gain", "square_drag_at_axis", "sensor_scale_of_angle"]},
    }
    return Study("rod", "ode", channels, tuple(runs), model=description)
