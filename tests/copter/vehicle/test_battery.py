"""Batteries: table, load, power, endurance, and the sag of a flight against scipy."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from diffsim.copter.dynamics.flight import FlightError, FlightState, fly
from diffsim.copter.vehicle.battery import LIPO_CELL_VOLTAGE, Battery
from diffsim.copter.vehicle.effects import FlightEffects
from diffsim.copter.vehicle.rotor import rotor_model
from tests.copter.vehicle.test_vehicle import plus_quadcopter
from tests.helpers import tensor


def test_lipo_follows_the_table():
    battery = Battery.lipo(cells=3, capacity_mah=2200)
    charge = np.linspace(0.05, 1.0, 20)
    fitted = battery.open_circuit(tensor(charge)).numpy() / 3
    assert np.abs(fitted - LIPO_CELL_VOLTAGE[1:]).max() < 0.04
    assert bool((battery.open_circuit(torch.linspace(0.05, 1, 50).double()).diff() > 0).all())
    assert float(battery.capacity) == pytest.approx(2.2 * 3600)


def test_power_is_voltage_times_current():
    battery = Battery.lipo(cells=4, capacity_mah=3000)
    charge, power = torch.linspace(0.1, 1.0, 9).double(), torch.linspace(10, 400, 9).double()
    current = battery.current_for_power(charge, power)
    torch.testing.assert_close(battery.voltage(charge, current) * current, power)
    # more load, more current: the smaller of the two roots
    assert bool((battery.voltage(charge, current) > 0.5 * battery.open_circuit(charge)).all())


def test_endurance():
    """A constant voltage without resistance gives E C / P; in general scipy's answer."""
    flat = Battery(
        capacity=tensor(7920.0),
        resistance=tensor(0.0),
        open_circuit_coefficients=tensor([11.1, 0.0, 0.0, 0.0]),
        nominal_voltage=tensor(11.1),
    )
    expected = 11.1 * 7920 * 0.8 / 100
    assert float(flat.endurance(tensor(100.0), reserve=0.2)) == pytest.approx(expected, rel=1e-12)

    battery = Battery.lipo(cells=3, capacity_mah=2200)

    def slope(_, charge):
        current = battery.current_for_power(tensor(charge), tensor(150.0))
        return -(current / battery.capacity).numpy()

    def empty(_, charge):
        return charge[0] - 0.1

    empty.terminal = True
    found = solve_ivp(slope, (0, 5000), [1.0], events=empty, rtol=1e-10, atol=1e-12)
    time = float(battery.endurance(tensor(150.0), reserve=0.1))
    assert time == pytest.approx(found.t_events[0][0], rel=1e-8)


def sagging_flight(**changes):
    battery = Battery.lipo(cells=3, capacity_mah=5.0)  # a tiny one, to be felt within seconds
    rotors = [rotor_model("kde2814_10in")] * 4
    sag = battery.sag(rotors, idle=0.3, **changes)
    commands = torch.full((1, 100, 4), 3.0, dtype=torch.float64)
    start = FlightState.at_rest(torch.zeros(1, 3, dtype=torch.float64))
    return sag, fly(plus_quadcopter(), start, commands, dt=0.01, effects=FlightEffects(battery=sag))


def test_flight_drains_as_the_differential_equation():
    """Charge, and the velocity of a thrust that falls with the voltage, against scipy."""
    sag, flight = sagging_flight()
    a, alpha = float(sag.current_coefficients[0]), float(sag.current_exponents[0])
    current = float(sag.idle_current) + 4 * a * 3.0**alpha
    c = sag.open_circuit.numpy()

    def slope(_, y):
        voltage = np.polynomial.polynomial.polyval(y[0], c) - float(sag.resistance) * current
        thrust = 12.0 * (voltage / float(sag.nominal_voltage)) ** float(sag.exponent)
        return [-current / float(sag.capacity), 9.81 - thrust / 1.2]

    exact = solve_ivp(slope, (0, 1), [1.0, 0.0], rtol=1e-11, atol=1e-12).y[:, -1]
    assert float(flight.state.charge[0, -1]) == pytest.approx(exact[0], rel=1e-9)
    assert float(flight.state.velocity[0, -1, 2]) == pytest.approx(exact[1], rel=1e-8)


def test_compensated_controller_feels_no_sag():
    _, flight = sagging_flight(exponent=0.0)
    expected = (9.81 - 12.0 / 1.2) * 1.0
    assert float(flight.state.velocity[0, -1, 2]) == pytest.approx(expected, rel=1e-12)


def test_empty_battery_is_reported():
    sag = Battery.lipo(cells=3, capacity_mah=1.0).sag([rotor_model("kde2814_10in")] * 4)
    commands = torch.full((1, 400, 4), 3.0, dtype=torch.float64)
    start = FlightState.at_rest(torch.zeros(1, 3, dtype=torch.float64))
    with pytest.raises(FlightError, match="battery of vehicle 0 is empty after step") as caught:
        fly(plus_quadcopter(), start, commands, dt=0.01, effects=FlightEffects(battery=sag))
    assert 0 < caught.value.step < 400


def test_bad_input():
    battery = Battery.lipo(cells=3, capacity_mah=2200)
    with pytest.raises(ValueError, match="power must not exceed"):
        battery.current_for_power(tensor(1.0), tensor(1e5))
    with pytest.raises(ValueError, match="cells must be a whole number"):
        Battery.lipo(cells=0, capacity_mah=2200)
    with pytest.raises(ValueError, match="rotors is empty"):
        battery.sag([])
    with pytest.raises(ValueError, match="num_points must be even"):
        battery.endurance(tensor(100.0), num_points=3)
