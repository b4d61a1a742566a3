"""Another nano quadrotor: a twin in the same file format, from a simulator of its own.

Its rotors turn with less than the battery's voltage, and feel the air. Both effects are larger than
at first: with half of the exponent and a third of the drag, the exponent could not be told from
none. The twin's motors have no lag. So it shows that the way works, not what the recordings tell.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from diffsim.data.study import Study
from tests.diagnose.discover.answers import found
from tests.systems import small_copter
from tests.systems.published.twins import load_twin, stated_of, write_table
from tests.systems.small_copter import Causes

SPEED_OF = 560.0  # of the description: rad/s for a volt
LOST = -0.8  # exponent of the voltage that the rotors lose
DRAG = 6e-5  # of every rotor [N s^2/m]
FLIGHTS = {
    "B2_circle_fast_rep1": ("circle", "fit"),
    "B3_figure8_fast_rep1": ("dash", "fit"),
    "B5_helix_fast_rep1": ("low", "select"),
    "B7_oval_medium_rep1": ("dash", "test"),
}


def write_flight(path: Path, kind: str, volts: float, seed: int) -> None:
    """A flight file with the columns that the description reads."""
    flight = small_copter.fly(kind, Causes(speed_drag=DRAG), seconds=3.2, dt=0.01, fine=2)
    rng, count = np.random.default_rng(seed), len(flight.time)
    battery = volts - 0.25 * flight.time / flight.time[-1] + 0.05 * np.sin(5.0 * flight.time)
    asked = flight.speeds / (SPEED_OF * battery[:, None] * (battery[:, None] / 3.9) ** LOST)
    groups = {
        ("px_m", "py_m", "pz_m"): (flight.position, 0.001),
        ("qw", "qx", "qy", "qz"): (flight.quaternion, 0.003),
        ("vx_m_s", "vy_m_s", "vz_m_s"): (flight.velocity, 0.02),
        ("wx_rad_s", "wy_rad_s", "wz_rad_s"): (flight.rates, 0.05),
        tuple(f"motor{k}_command" for k in (1, 2, 3, 4)): (asked, 0.0),
    }
    table = {"time_s": flight.time, "battery_V": battery}
    for names, (values, sd) in groups.items():
        noisy = values + sd * rng.standard_normal((count, len(names)))
        table |= dict(zip(names, noisy.T, strict=True))
    write_table(path, table)


@pytest.fixture(scope="module")
def study(tmp_path_factory) -> Study:
    """The published description, its vehicle that of the other simulator."""
    folder = tmp_path_factory.mktemp("nanobench")
    stated, runs = stated_of("nanobench"), []
    for k, (name, (kind, use)) in enumerate(FLIGHTS.items()):
        write_flight(folder / f"{name}.csv", kind, 4.1 - 0.12 * k, k)
        runs.append(
            {"name": name, "file": f"{name}.csv", "from_s": 0.5, "until_s": 3.0, "use": use}
        )
    model = stated["model"]
    rotors = zip(small_copter.PLACES.tolist(), small_copter.SPINS, strict=True)
    model |= {
        "mass": small_copter.MASS,
        "inertia": np.diag(small_copter.INERTIA).tolist(),
        "rotors": [{"at": place, "spin": spin} for place, spin in rotors],
        "radius": small_copter.RADIUS,
        "thrust": {"coefficient": {"value": small_copter.COEFFICIENT, "percent": 20}},
        "torque_ratio": small_copter.TORQUE_RATIO,
        "motor_lag": {"value": 0.001, "percent": 60},
    }
    return load_twin(folder, stated | {"runs": runs})


@pytest.mark.cpu(15)  # a whole diagnosis of flights
def test_what_the_rotors_lose_and_the_drag_are_named_with_their_sizes(study):
    report = found(study)
    assert set(report.best_names) == {"body_drag", "voltage_exponent"}, report.sentences
    size = {row.name: row.size["size"] for row in report.causes if "size" in row.size}
    # thrust goes with the square of the speed
    assert size["voltage_exponent"].low < 2.0 * LOST < size["voltage_exponent"].high
    hover = np.sqrt(small_copter.MASS * small_copter.GRAVITY / 4 / small_copter.COEFFICIENT)
    assert size["body_drag"].low < 4.0 * hover * DRAG < size["body_drag"].high
