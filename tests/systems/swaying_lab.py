"""A swaying clamp and the bar in it by beam theory: nothing here is shared with the soft bed.

Timoshenko's beam in cubic elements (Przemieniecki 1968), its lowest modes driven by the clamp's
acceleration and integrated by scipy.
"""

import numpy as np
from scipy import linalg

from diffsim.data.study import Channel, Run, Study

YOUNG, NU, DENSITY, BETA = 2.3e5, 0.45, 1070.0, 2e-3
# Weak gravity: the theory is linear, while a bar that sags also feels its clamp's forward inertia.
LENGTH, SIDE, GRAVITY = 0.1, 0.03, 1.0
SHIFT, TURN = 1.0, 0.25  # of the clamp's record; turn per forward displacement and length
NUM_ELEMENTS, NUM_MODES = 20, 3
#: A bar that a hand holds at its tip until the first sample, at a height that nobody knows
HELD_START = {
    "shape": "held",
    "where": {"x": 0},
    "axes": "z",
    "offset": {"value": 3e-3, "sd": 2e-3, "per": "run"},
    "speed": {"value": 0.0, "sd": 0.05, "per": "run"},
}


def beam_matrices():
    """Mass and stiffness of the free nodes (w, slope)."""
    area, inertia = SIDE**2, SIDE**4 / 12.0
    shear = YOUNG / (2.0 * (1.0 + NU)) * 10.0 * (1.0 + NU) / (12.0 + 11.0 * NU)
    h = LENGTH / NUM_ELEMENTS
    phi = 12.0 * YOUNG * inertia / (shear * area * h**2)
    k = np.array(
        [
            [12.0, 6 * h, -12.0, 6 * h],
            [6 * h, (4 + phi) * h**2, -6 * h, (2 - phi) * h**2],
            [-12.0, -6 * h, 12.0, -6 * h],
            [6 * h, (2 - phi) * h**2, -6 * h, (4 + phi) * h**2],
        ]
    )
    k *= YOUNG * inertia / ((1.0 + phi) * h**3)
    m = DENSITY * area * h / 2.0 * np.eye(4)  # lumped
    m[1, 1] = m[3, 3] = DENSITY * inertia * h / 2.0 + DENSITY * area * h**3 / 24.0
    size = 2 * (NUM_ELEMENTS + 1)
    mass, stiff = np.zeros((size, size)), np.zeros((size, size))
    for e in range(NUM_ELEMENTS):
        rows = slice(2 * e, 2 * e + 4)
        mass[rows, rows] += m
        stiff[rows, rows] += k
    return mass[2:, 2:], stiff[2:, 2:]


def clamp(time, amplitude_m):
    """Forward and upward places of a clamp that a swing has set going (num_samples, 2) [m]."""
    grown = amplitude_m * np.exp(-time / 0.4)
    forward = grown * np.sin(2 * np.pi * 8.4 * time)
    return np.column_stack([forward, -0.4 * grown * np.sin(2 * np.pi * 8.4 * time + 0.4)])


def swing(time, places, start_m):
    """Height of the tip over where the bar would be straight, seen from the room [m]."""
    from scipy.signal import lsim

    mass, stiff = beam_matrices()
    squared, modes = linalg.eigh(stiff, mass, subset_by_index=[0, NUM_MODES - 1])
    x = np.linspace(0.0, LENGTH, NUM_ELEMENTS + 1)[1:]
    rigid = np.zeros((2 * NUM_ELEMENTS, 2))  # per shift up, per turn about y
    rigid[::2, 0], rigid[::2, 1], rigid[1::2, 1] = 1.0, -x, -1.0
    fine = np.arange(0.0, time[-1] + 1e-4, 2.5e-4)
    motion = np.column_stack(
        [
            SHIFT * np.interp(fine, time, places[:, 1]),
            TURN / LENGTH * np.interp(fine, time, places[:, 0]),
        ]
    )
    pull = -modes.T @ mass @ rigid
    sag = linalg.solve(stiff, mass @ rigid[:, 0] * GRAVITY)
    held = linalg.solve(stiff, np.eye(len(stiff))[-2])  # by a hand at the tip, until the start
    amplitude = modes.T @ mass @ held * start_m / held[-2]
    tip = np.zeros(len(fine))
    acceleration = np.gradient(np.gradient(motion, fine, axis=0), fine, axis=0)
    for i in range(NUM_MODES):
        rates = [[0.0, 1.0], [-squared[i], -BETA * squared[i]]]
        system = (rates, [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])
        _, shown, _ = lsim(system, acceleration @ pull[i], fine, X0=[amplitude[i], 0.0])
        tip += modes[-2, i] * shown
    seen = tip - sag[-2] + motion @ rigid[-2]
    return np.interp(time, fine, seen)


def recorded(*, noise_m=1e-5, seed=0, until_s=0.7):
    """One run to fit, and one that starts and sways otherwise, held out."""
    rng, runs = np.random.default_rng(seed), []
    fine = np.arange(0.0, until_s + 0.1, 1e-3)
    cases = (("first", 3e-3, 8e-5, "fit"), ("second", 2.5e-3, -1.2e-4, "test"))
    for order, (name, start_m, sway_m, use) in enumerate(cases):
        time = np.arange(0.0, until_s, 0.01)
        places = clamp(fine, sway_m)
        height = np.interp(time, fine, swing(fine, places, start_m))
        height = height + noise_m * rng.standard_normal(len(time))
        shown = places[::10][: len(time)]
        command = {"support_x_m": shown[:, 0], "support_z_m": shown[:, 1]}
        runs.append(Run(name, time, height[:, None], command, name, order=order, use=use))
    channel = Channel("tip_z_m", "m", "position", sd=noise_m)
    return Study("swaying", "soft_body", (channel,), tuple(runs), {})
