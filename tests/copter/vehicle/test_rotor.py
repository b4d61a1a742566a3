"""Rotor models: fits recover what made the data, bench figures, maps and their inverses."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml

from diffsim.copter.vehicle.battery import USUAL_SAG_EXPONENT
from diffsim.copter.vehicle.fit_rotor import fit_power, fit_rotor, write_rotor
from diffsim.copter.vehicle.rotor import (
    RotorModel,
    motor_lag,
    rotor_model,
    rotor_names,
    rotor_record,
)
from diffsim.copter.vehicle.rotor_table import RotorTable, read_rotor_bench
from tests.measured import data_folder


def tables():
    data_folder("copter_reference")  # holds the KDE motors' tables
    return read_rotor_bench(data_folder("rotor_bench"))


def synthetic(noise=0.0, seed=0):
    """A table made from known numbers: thrust 4e-6 w^2.1 + 0.2, current 0.6 u^1.3 + 0.1."""
    rng = np.random.default_rng(seed)
    signal = np.linspace(1200.0, 2000.0, 30)
    voltage = np.where(np.arange(30) % 2, 11.0, 7.5)
    speed = 250.0 * (voltage * (signal - 1050.0) / 1000.0) ** 0.6
    thrust = 4e-6 * speed**2.1 + 0.2
    table = RotorTable(
        name="made",
        title="made",
        radius=0.127,
        nominal_voltage=11.1,
        signal=signal,
        speed=speed,
        thrust=thrust + noise * rng.standard_normal(30),
        current=(0.6 * thrust**1.3 + 0.1) * 11.1 / voltage,
        torque=0.015 * thrust,
        voltage=voltage,
        down=np.zeros(30, dtype=bool),
        source="formula",
    )
    return table


def test_fit_recovers_what_made_the_table():
    model = fit_rotor(synthetic()).model
    expected = {
        "thrust_coefficient": 4e-6,
        "thrust_exponent": 2.1,
        "thrust_offset": 0.2,
        "torque_ratio": 0.015,
        "current_coefficient": 0.6,
        "current_exponent": 1.3,
        "current_offset": 0.1,
        "duty_offset": 0.05,
        "speed_coefficient": 250.0,
        "speed_exponent": 0.6,
    }
    for name, value in expected.items():  # exact data: the solver's tolerance
        assert getattr(model, name) == pytest.approx(value, rel=1e-6), name


def test_standard_errors_are_those_of_repetition():
    """Spread of 200 noisy fits against the error that one states: 5 % sampling of the spread."""
    fits = [synthetic(noise=0.05, seed=seed) for seed in range(200)]
    curves = [fit_power(t.speed, t.thrust, offset=True) for t in fits]
    for name in ("exponent", "offset"):
        spread = np.std([c.values[name] for c in curves])
        stated = np.mean([c.standard_errors[name] for c in curves])
        assert stated == pytest.approx(spread, rel=0.2)


def test_kde_exponents_and_ratio():
    """Design page: p is 2.08-2.12; up and down apart it is 2.14 and 2.10, the 14 inch one 2.07."""
    table = tables()["kde2814_10in"]
    fit = fit_rotor(table)
    assert fit.model.thrust_exponent == pytest.approx(2.121, abs=0.001)
    assert fit.hysteresis["exponent_up"] == pytest.approx(2.144, abs=0.001)
    assert fit.hysteresis["exponent_down"] == pytest.approx(2.098, abs=0.001)
    # an independent estimate: straight line through logarithms, which weighs small thrusts more
    rows = table.turning
    slope = np.polyfit(np.log(rows.speed), np.log(rows.thrust), 1)[0]
    assert fit.model.thrust_exponent == pytest.approx(slope, abs=0.06)
    # torque_to_thrust of the public tool (copter_reference), which counts the rows at standstill
    assert fit.model.torque_ratio == pytest.approx(0.0146639752508, rel=1e-7)
    fourteen = fit_rotor(tables()["kde2814_14in"]).model
    assert fourteen.thrust_exponent == pytest.approx(2.078, abs=0.001)
    assert fourteen.torque_ratio == pytest.approx(0.0168552041004, rel=1e-7)
    assert fourteen.max_thrust == 11.672  # of the sweep down


def test_sweeps_differ_by_signal_not_by_speed():
    """Down the battery is emptier: 2 % less thrust at one signal, 0.1 % more at one speed."""
    hysteresis = fit_rotor(tables()["kde2814_10in"]).hysteresis
    assert abs(hysteresis["thrust_at_equal_speed"]) < 0.003
    assert -0.03 < hysteresis["thrust_at_equal_signal"] < -0.01


def test_exponent_beats_the_square():
    """A free exponent fits every table better than the square; by F > 4 for most."""
    better = 0
    for table in tables().values():
        rows = table.turning
        fit = fit_power(rows.speed, rows.thrust, offset=False)
        square = rows.speed**2
        c = float(square @ rows.thrust / (square @ square))
        of_square = float(np.sum((rows.thrust - c * square) ** 2))
        of_fit = float(np.sum(fit.residuals**2))
        assert of_fit <= of_square * (1 + 1e-9)
        better += (of_square - of_fit) / (of_fit / (len(rows.speed) - 2)) > 4.0
    assert better >= 12


def test_shipped_models_are_the_fits(tmp_path):
    for name, table in tables().items():
        path = write_rotor(fit_rotor(table), tmp_path)
        shipped = rotor_model(name)
        fitted = fit_rotor(table).model
        for field, value in vars(shipped).items():
            if isinstance(value, float):  # ten digits are written; solvers differ by less than 1e-5
                assert value == pytest.approx(getattr(fitted, field), rel=1e-5, abs=1e-9)
            else:
                assert value == getattr(fitted, field)
        assert path.is_file()


def test_records_state_their_source():
    assert len(rotor_names()) == 14
    for name in rotor_names():
        record = rotor_record(name)
        source = record["provenance"]["source"]
        assert source.startswith(("rotor_bench/", "copter_reference/"))
        assert record["fit"]["thrust"]["rows"] >= 13


def test_a_rotor_file_is_read_key_by_key(monkeypatch):
    text = yaml.safe_dump({"model": {"name": "mine", "radius": "5 inch", "thrust_exponant": 2.0}})
    monkeypatch.setattr("diffsim.copter.vehicle.rotor.read_shipped", lambda *names: text)
    with pytest.raises(ValueError, match=r"^mine.yaml: model: no key 'thrust_exponant' here; did"):
        rotor_model("mine")


def test_model_goes_through_the_rows():
    """Within three times the fit's own rms at every fifth row."""
    for name, table in tables().items():
        model, rows = rotor_model(name), table.turning
        thrust = model.thrust(torch.as_tensor(rows.speed)).numpy()
        assert np.sqrt(np.mean((thrust - rows.thrust) ** 2)) < 0.012 * rows.thrust.max()
        speed = model.speed_at(
            torch.as_tensor(rows.signal),
            torch.as_tensor(
                rows.voltage if rows.voltage is not None else np.full_like(rows.speed, 11.1)
            ),
        ).numpy()
        assert np.sqrt(np.mean((speed - rows.speed) ** 2)) < 0.02 * rows.speed.max()


def test_thrust_against_voltage():
    """Rows at 11.1 and 7.4 V with equal signals against thrust exponent times speed exponent."""
    measured = []
    for name, table in tables().items():
        if table.voltage is None:
            continue
        model, high = rotor_model(name), table.voltage > 9.0
        upper, lower = table.rows(high).turning, table.rows(~high).turning
        _, i, j = np.intersect1d(upper.signal, lower.signal, return_indices=True)
        i, j = i[-6:], j[-6:]  # weak signals are near the stand's resolution
        ratio = np.log(upper.thrust[i] / lower.thrust[j])
        slope = float(np.mean(ratio / np.log(upper.voltage[i] / lower.voltage[j])))
        assert model.thrust_exponent * model.speed_exponent == pytest.approx(slope, abs=0.15)
        measured.append(slope)
    assert np.mean(measured) == pytest.approx(USUAL_SAG_EXPONENT, abs=0.02)


@pytest.mark.parametrize("name", ["kde2814_14in", "rs2205s_lumenier5053x3"])
def test_maps_and_their_inverses(name):
    model = rotor_model(name)
    thrust = torch.linspace(0.1, float(model.max_thrust), 20, dtype=torch.float64)
    torch.testing.assert_close(model.thrust(model.speed(thrust)), thrust)
    signal = model.signal(thrust, 11.1)
    inside = (signal > 1000.0) & (signal < 2000.0)
    assert inside.sum() > 10
    back = model.thrust(model.speed_at(signal, 11.1))
    torch.testing.assert_close(back[inside], thrust[inside])
    # less voltage needs more signal
    assert bool((model.signal(thrust, 10.0)[inside] >= signal[inside]).all())


def test_standstill():
    model = rotor_model("kde2814_10in")
    zero = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    for value in (model.thrust(zero), model.speed(zero), model.current(zero)):
        assert bool(torch.isfinite(value).all())
        (grad,) = torch.autograd.grad(value.sum(), zero, allow_unused=True)
        assert grad is None or bool(torch.isfinite(grad).all())
    assert float(model.thrust(0.0)) == 0.0
    assert float(model.speed(0.0)) == 0.0


@pytest.mark.parametrize("name", ["speed", "current", "power", "signal"])
def test_a_negative_thrust_is_refused(name):
    """It passed for idle, without a word."""
    of = getattr(rotor_model("kde2814_10in"), name)
    with pytest.raises(ValueError, match=r"thrust must lie in .*got -0\.5; .*do not turn backward"):
        of(torch.tensor([1.0, -0.5], dtype=torch.float64))
    # what an optimizer leaves below zero is none
    assert float(of(-1e-9)) == float(of(0.0))


def test_effects_of_models():
    rotors = [rotor_model("kde2814_10in"), rotor_model("kde2814_14in")]
    assert motor_lag(rotors).time_constants.tolist() == [0.05, 0.05]
    with pytest.raises(ValueError, match="time_constant of kde2814_10in"):
        motor_lag([replace(rotors[0], time_constant=None)])


def test_unknown_name_offers_the_closest():
    with pytest.raises(ValueError, match="did you mean 'kde2814_10in'"):
        rotor_model("kde2814-10in")


def test_bad_input():
    model = rotor_model("kde2814_10in")
    with pytest.raises(ValueError, match="torque of f40iii_gemfan5040x2 was not measured"):
        rotor_model("f40iii_gemfan5040x2").torque(1.0)
    table = synthetic()
    with pytest.raises(ValueError, match="needs 6"):
        fit_rotor(table.rows(np.arange(30) < 5))
    with pytest.raises(ValueError, match="differ in length"):
        replace(table, speed=table.speed[:-1])
    with pytest.raises(ValueError, match="must be finite"):
        replace(table, thrust=np.full(30, np.nan))
    assert isinstance(model, RotorModel)


def test_figure():
    pytest.importorskip("matplotlib")
    from diffsim.viz.rotors import rotor_fit

    figure = rotor_fit(fit_rotor(synthetic(noise=0.05)))
    assert len(figure.axes) == 8


@pytest.mark.parametrize("name", rotor_names())
def test_power_is_voltage_times_current_at_any_voltage(name):
    rotor = rotor_model(name)
    thrust = torch.linspace(0.1, 1.0, 5, dtype=torch.float64) * rotor.max_thrust
    for voltage in (0.8, 1.0, 1.3):
        volts = voltage * float(rotor.nominal_voltage)
        torch.testing.assert_close(volts * rotor.current(thrust, volts), rotor.power(thrust))
    nominal = float(rotor.nominal_voltage)
    torch.testing.assert_close(nominal * rotor.current(thrust), rotor.power(thrust))
