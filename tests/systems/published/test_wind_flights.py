"""Flights before fans: twins in the same file format, and what the page says of the recordings."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.wind_flights import GUST, LIMIT, TYPICAL, fit_own, unexplained
from diffsim.cli.diagnose_inputs import read_study
from diffsim.data.study import Study
from diffsim.identify.extended import ExtendedModel
from diffsim.systems.registry import setup_of
from tests.measured import data_folder
from tests.systems.published.twins import load_twin, stated_of, write_table

GRAVITY, DRAG, LAG = 9.81, 0.3, 0.06  # as the description believes


def write_flight(path: Path, wind: float, gust: float, period: float, seed: int) -> None:
    """A flight file: hover for 8 s, then the figure of period 2 pi s, in a wind along x.

    The attitude and the thrust are those that the motion asks for under gravity and linear drag.
    """
    t = np.arange(0.0, 40.0, 0.02)
    grows = np.clip((t - 8.0) / 4.0, 0.0, 1.0)
    x, z = 1.25 * grows * np.sin(t), 2.0 + 0.75 * grows * np.sin(2.0 * t)
    vx, vz = np.gradient(x, t), np.gradient(z, t)
    air = wind + gust * np.sin(2.0 * np.pi * t / period + 0.7)
    fx = np.gradient(vx, t) + DRAG * (vx - air)
    fz = np.gradient(vz, t) + GRAVITY + DRAG * vz
    tilt, thrust = np.arctan2(fx, fz), np.hypot(fx, fz) / GRAVITY
    command = 0.46 * (thrust + LAG * np.gradient(thrust, t))
    rng, nothing = np.random.default_rng(seed), np.zeros_like(t)
    table = {
        "time_s": t,
        **{"x_m": x, "y_m": nothing, "z_m": z, "goal_x_m": x, "goal_y_m": nothing, "goal_z_m": z},
        "vx_m_s": vx + 0.002 * rng.normal(size=len(t)),
        "vy_m_s": 0.002 * rng.normal(size=len(t)),
        "vz_m_s": vz + 0.002 * rng.normal(size=len(t)),
        **{"qx": nothing, "qy": np.sin(tilt / 2), "qz": nothing, "qw": np.cos(tilt / 2)},
        **{"thrust_command": command, "hover_throttle": 0.46 + nothing},
        **{f"residual_{axis}": rng.normal(size=len(t)) for axis in "xyz"},
    }
    write_table(path, table)


@pytest.fixture(scope="module")
def study(tmp_path_factory) -> Study:
    """Three flights of the published description: a gust of 4.4 s, one of the figure's own period,
    and a steady wind."""
    folder = tmp_path_factory.mktemp("wind")
    write_flight(folder / "flight_01.csv", -6.0, 2.0, 4.4, 1)
    write_flight(folder / "flight_02.csv", -6.0, 2.0, 2.0 * np.pi, 2)
    write_flight(folder / "flight_03.csv", -6.0, 0.0, 5.0, 3)
    return load_twin(
        folder, stated_of("wind_flights") | {"runs": [{"file": "flight_{number}.csv"}]}
    )


@pytest.fixture(scope="module")
def fitted(study) -> dict[str, dict[str, float]]:
    """Own values of each flight in the plain model, by name."""
    setup = setup_of(study)
    model = ExtendedModel(setup.model, (), setup.model.base)
    names = ("wind_x", "wind_y", "hover_gain", *GUST)
    out = {}
    for run in study.runs:
        q, _, _ = fit_own(model, run, names)
        own = [(i, p) for i, p in enumerate(model.base) if p.name.endswith("@" + run.name)]
        values = {p.name.partition("@")[0]: (p, q[i]) for i, p in own}
        out[run.name] = {
            name: p.value * np.exp(p.sd * x) if p.log else p.value + p.sd * x
            for name, (p, x) in values.items()
        }
    return out


@pytest.mark.parametrize(("flight", "period"), [("flight_01", 4.4), ("flight_02", 2.0 * np.pi)])
def test_a_gust_is_found_with_its_period_and_size(fitted, flight, period):
    own = fitted[flight]
    assert 1.0 / own["gust_frequency"] == pytest.approx(period, rel=0.005)
    assert np.hypot(own["gust_sine"], own["gust_cosine"]) == pytest.approx(2.0, rel=0.1)
    assert own["wind_x"] == pytest.approx(-6.0, abs=0.2)


def test_no_gust_where_the_flight_repeats_in_a_steady_wind(fitted):
    own = fitted["flight_03"]
    assert np.hypot(own["gust_sine"], own["gust_cosine"]) < 0.2 * LIMIT * TYPICAL
    assert own["wind_x"] == pytest.approx(-6.0, abs=0.2)


def test_the_authors_residual_is_not_read(study):
    assert all("residual" not in column.name for column in study.columns)
    assert all("residual" not in column.header for column in study.columns)


def test_a_hovering_flight_leaves_the_drag_of_the_wind(study):
    run = study.runs[2]
    still = run.time_s < 7.0
    assert unexplained(run)[still, 0].mean() == pytest.approx(DRAG * -6.0, rel=0.02)


@pytest.mark.slow
@pytest.mark.reference
def test_three_recorded_flights_have_a_gust():
    folder = data_folder("wind_flights")
    if not list(folder.glob("flight_*.csv")):
        pytest.skip("flights are made by the set's make_csv.py")
    recorded = read_study("wind_flights")
    setup = setup_of(recorded)
    model = ExtendedModel(setup.model, (), setup.model.base)
    amplitudes = {}
    for run in recorded.runs:
        q, _, _ = fit_own(model, run, ("wind_x", "wind_y", "hover_gain", *GUST))
        own = {p.name: p.value + p.sd * x for p, x in zip(model.base, q, strict=True)}
        amplitudes[run.name] = np.hypot(*(own[f"{name}@{run.name}"] for name in GUST[:2]))
    largest = sorted(amplitudes, key=amplitudes.__getitem__)[-3:]
    assert set(largest) == {"flight_06", "flight_10", "flight_11"}
    assert min(amplitudes[name] for name in largest) > LIMIT * TYPICAL
