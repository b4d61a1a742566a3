"""Another nano quadrotor: a twin in the same file format, from a simulator of its own.

Its rotors turn with less than the battery's voltage, and feel the air. Both effects are larger than
at first: with half of the exponent and a third of the drag, the exponent could not be told from
none. The twin's motors have no lag. So it shows that the way works, not what the recordings tell.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.ahead import Balance, Record, compared, flown, naive
from diffsim.data.study import Study
from diffsim.identify.extended import ExtendedModel
from diffsim.systems.registry import setup_of
from tests.diagnose.discover.answers import found
from tests.systems import small_copter
from tests.systems.published.twins import load_twin, stated_of, write_table
from tests.systems.small_copter import Causes

SPEED_OF = 560.0  # of the description: rad/s for a volt
LOST = -0.8  # exponent of the voltage that the rotors lose
DRAG = 6e-5  # of every rotor [N s^2/m]
FEELS_THE_AIR = Causes(speed_drag=DRAG)
FLIGHTS = {
    "B2_circle_fast_rep1": ("circle", "fit"),
    "B3_figure8_fast_rep1": ("dash", "fit"),
    "B5_helix_fast_rep1": ("low", "select"),
    "B7_oval_medium_rep1": ("dash", "test"),
}


def write_flight(
    path: Path, kind: str, volts: float, seed: int, causes: Causes = FEELS_THE_AIR
) -> None:
    """A flight file with the columns that the description reads."""
    flight = small_copter.fly(kind, causes, seconds=3.2, dt=0.01, fine=2)
    rng, count = np.random.default_rng(seed), len(flight.time)
    battery = volts - 0.25 * flight.time / flight.time[-1] + 0.05 * np.sin(5.0 * flight.time)
    lost = LOST if causes == FEELS_THE_AIR else 0.0
    asked = flight.speeds / (SPEED_OF * battery[:, None] * (battery[:, None] / 3.9) ** lost)
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
    describe(stated["model"])
    return load_twin(folder, stated | {"runs": runs})


def describe(model: dict[str, Any]) -> None:
    """Put the vehicle of the other simulator in the place of the described one."""
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


@pytest.mark.story  # a whole diagnosis of flights
def test_what_the_rotors_lose_and_the_drag_are_named_with_their_sizes(study):
    report = found(study)
    assert set(report.best_names) == {"body_drag", "voltage_exponent"}, report.sentences
    size = {row.name: row.size["size"] for row in report.causes if "size" in row.size}
    # thrust goes with the square of the speed
    assert size["voltage_exponent"].low < 2.0 * LOST < size["voltage_exponent"].high
    hover = np.sqrt(small_copter.MASS * small_copter.GRAVITY / 4 / small_copter.COEFFICIENT)
    assert size["body_drag"].low < 4.0 * hover * DRAG < size["body_drag"].high


def test_the_second_before_a_start_tells_how_the_rotors_of_a_flight_are_balanced(tmp_path):
    """One rotor gives less in this flight, another turns the body more: no state at a start shows
    it, and the flight before it does."""
    hidden = Causes(shares=(0.93, 1.0, 1.0, 1.0), torques=(1.0, 1.15, 1.0, 1.0))
    write_flight(tmp_path / "flight.csv", "circle", 3.9, 0, hidden)
    stated = stated_of("nanobench")
    describe(stated["model"])
    run = {"name": "flight", "file": "flight.csv"}
    study = load_twin(tmp_path, stated | {"runs": [run]})
    setup, run = setup_of(study), study.runs[0]
    model = ExtendedModel(setup.model, (), setup.model.base)
    truth = Record.of(torch.as_tensor(run.measured, dtype=torch.float64))
    starts = torch.arange(110, 260, 5)
    flies = torch.ones(len(truth.position), dtype=torch.bool)
    predictions = {
        "hold": naive(truth),
        "state alone": flown(model, run),
        "past known": flown(model, run, balance=Balance(flies, prior=0)),
    }
    total = {k: e.sum(0) for k, e in compared(predictions, truth, starts=starts).errors.items()}
    assert bool((total["state alone"] > total["hold"])[1:].any())
    assert bool((total["past known"] < 0.4 * total["hold"]).all()), total
    assert bool((total["past known"] < 0.5 * total["state alone"]).all()), total
    # what follows a start does not count: another flight after it, the same prediction
    later = run.measured.copy()
    later[201:] = later[200]
    other = flown(model, replace(run, measured=later), balance=Balance(flies))
    same = flown(model, run, balance=Balance(flies))
    for a, b in zip(other(torch.tensor([200])).parts, same(torch.tensor([200])).parts, strict=True):
        torch.testing.assert_close(a, b, rtol=0.0, atol=1e-12)
