"""Closed-loop flights: hold their place, obey clamp, battery and ground, refuse what cannot fly."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.copter import (
    FlightEffects,
    FlightError,
    FlightState,
    HoverError,
    load_design,
    rotor_model,
)
from diffsim.copter.simulator import (
    FlightSensors,
    FlightSimulator,
    Ground,
    LqrController,
    MotorOutputs,
    PayloadError,
    Setpoint,
    flight_rotors,
    mission_from_text,
    payload_limit,
    with_payload,
)
from diffsim.copter.simulator.sensing import SensorNoise, SensorStream, StateEstimator
from diffsim.copter.vehicle.battery import Battery
from diffsim.copter.vehicle.effects import BodyDrag
from diffsim.copter.vehicle.mass import Moments, rigid_body
from diffsim.copter.vehicle.multicopter import GRAVITY
from tests.copter.flight_cases import tensor
from tests.copter.vehicle.test_vehicle import plus_quadcopter

TEN_INCH = [rotor_model("kde2814_10in")] * 4
PACK = Battery.lipo(cells=3, capacity_mah=2200.0)
SHORT = mission_from_text(
    "name: short\nsteps:\n  - take_off: {height: 1, speed: 0.8}\n  - hover: {seconds: 3}"
)
SILENT = FlightSensors(
    noise=SensorNoise(
        gyro=0.0, gyro_bias=0.0, accelerometer=0.0, accelerometer_bias=0.0, position=0.0
    ),
    attitude=0.0,
)


def quadcopter(**options):
    return FlightSimulator(plus_quadcopter(), rotors=TEN_INCH, **options)


@pytest.fixture(scope="module")
def flights():
    """The short mission under both controllers, with the usual noise."""
    return {name: quadcopter(controller=name).run(SHORT) for name in ("lqr", "pid")}


@pytest.fixture(scope="module")
def hovered():
    """A simulator that flew the short mission without noise; copy it to fly on."""
    simulator = quadcopter(sensors=None)
    simulator.run(SHORT)
    return simulator


@pytest.mark.parametrize("name", ["lqr", "pid"])
def test_hovers_with_noise(flights, name):
    """Position noise of 2 cm is filtered; the place is held to 3 cm over the last two seconds."""
    log = flights[name]
    last = log.series("time") > log.series("time")[-1] - 2.0
    assert np.sqrt(np.mean(log.position_error[last] ** 2)) < 0.03
    assert log.outcome == "done"
    assert not log.series("saturated").any()


def test_estimate_beats_the_reading(flights):
    log = flights["lqr"]
    off = np.linalg.norm(log.series("estimate") - log.series("position"), axis=1)
    assert np.sqrt(np.mean(off[100:] ** 2)) < 0.5 * np.sqrt(3.0) * SensorNoise().position


@pytest.mark.parametrize("name", ["lqr", pytest.param("pid", marks=pytest.mark.story)])
def test_any_heading_and_a_far_place(name):
    mission = mission_from_text(
        "name: turned\nsteps:\n  - take_off: {height: 1, speed: 1}\n"
        "  - yaw: {degrees: 150, rate: 90}\n"
        "  - fly_to: {north: 2, east: -1, speed: 2}\n  - hover: {seconds: 2}"
    )
    log = FlightSimulator(load_design("x_quadcopter"), controller=name, sensors=None).run(mission)
    np.testing.assert_allclose(log.series("position")[-1], [2.0, -1.0, -1.0], atol=0.06)
    assert log.series("rpy")[-1, 2] == pytest.approx(np.radians(150.0), abs=0.02)


@pytest.mark.property
def test_lqr_does_not_care_where_north_is():
    """World and target turned together ask for the same thrusts, also when far and fast."""
    controller = LqrController(load_design("pentacopter").multicopter())
    rng = np.random.default_rng(0)
    rpy = torch.from_numpy(0.2 * rng.standard_normal(3))
    position, velocity = (torch.from_numpy(rng.standard_normal(3)) for _ in range(2))
    rates = torch.from_numpy(0.1 * rng.standard_normal(3))

    def asked(turn):
        about = FlightState.at_rest(torch.zeros(1, 3).double(), tensor([[0.0, 0.0, turn]])).rotation
        state = FlightState.at_rest((about @ position), (rpy + tensor([0.0, 0.0, turn]))[None])
        state = replace(state, velocity=about @ velocity, body_rates=rates[None])
        target = (about[0] @ tensor([1.0, 2.0, -3.0])).tolist()
        return controller.thrusts(state, Setpoint(position=tuple(target), yaw=turn), 0.01)

    torch.testing.assert_close(asked(0.0), asked(2.5), rtol=0, atol=1e-10)
    assert float((asked(0.0) - controller.trim.thrusts).abs().max()) > 0.1


@pytest.mark.property
def test_lqr_is_the_feedback_of_the_state_of_12():
    """Near the place at heading north: u - K (x - target), the matrix product of thesis 3.3.3."""
    controller = LqrController(plus_quadcopter())
    x = tensor(0.05 * np.random.default_rng(1).standard_normal(12))
    x[5] = 0.0
    asked = controller.thrusts(FlightState.from_minimal(x[None]), Setpoint(position=(0, 0, 0)), 0.1)
    torch.testing.assert_close(asked, controller.trim.thrusts - controller.gain @ x)


def test_follows_accelerating_and_turning_targets():
    """Without noise, 2 m in 2.9 s and 90 degrees in 2.4 s.

    What stays is the lag of attitude and motors: measured 0.141 m, 0.021 m and 0.279 rad. With the
    sign of the lean, of the lift or of the yaw rate turned: 0.87 m, 0.22 m, 1.95 rad.
    """
    mission = mission_from_text(
        "steps:\n  - take_off: {height: 1, speed: 2}\n  - fly_to: {north: 2, east: 1, speed: 3}\n"
        "  - yaw: {degrees: 90, rate: 90}"
    )
    log = quadcopter(sensors=None).run(mission)
    off = np.abs(log.series("position") - log.series("target")).max(axis=0)
    assert np.hypot(*off[:2]) < 0.15
    assert off[2] < 0.03
    assert np.abs(log.series("rpy")[:, 2] - log.series("target_yaw")).max() < 0.3


def test_pulses_make_up_for_the_voltage(hovered):
    """Thrusts settled in hover are the bench's at the pulses and the voltage recorded."""
    sample = hovered.log.samples[-1]
    assert abs(sample.voltage - float(PACK.nominal_voltage)) > 0.5
    expected = TEN_INCH[0].thrust(TEN_INCH[0].speed_at(tensor(sample.pwm), sample.voltage))
    np.testing.assert_allclose(sample.thrusts, expected, rtol=2e-3)  # lag of a slow change


def test_attitude_targets_tilt_and_let_go(hovered):
    """10 degrees nose down push forward; nothing holds the place, only the height."""
    simulator = copy.deepcopy(hovered)
    for _ in range(150):
        simulator.step(Setpoint(position=(0, 0, -1), pitch=-np.radians(10), hold_attitude=True))
    sample = simulator.log.samples[-1]
    assert sample.rpy[1] == pytest.approx(-np.radians(10), abs=0.01)
    # g tan(10 degrees) for 1.5 s, less the time of leaning over
    assert 1.5 < sample.velocity[0] < 1.5 * GRAVITY * np.tan(np.radians(10))
    assert sample.position[2] == pytest.approx(-1.0, abs=0.1)
    assert simulator.log.position_error[-1] < 0.1  # of the height alone
    with pytest.raises(ValueError, match="controller 'lqr'"):
        quadcopter(controller="pid").step(Setpoint(position=(0, 0, -1), hold_attitude=True))


def test_same_seed_same_flight(flights):
    again, other = (quadcopter(seed=seed) for seed in (0, 1))
    one = flights["lqr"].series("position")[:80]
    same, different = (s.run(SHORT, seconds=0.79).series("position") for s in (again, other))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, different)


def test_without_noise_the_estimate_is_the_state():
    """Free fall of a spinning body, read without noise."""
    dt, position = 0.01, np.array([0.0, 0.0, -5.0])
    start = FlightState.at_rest(tensor(position)[None])
    estimator = StateEstimator(SILENT, dt, start)
    stream = SensorStream(SILENT, 0)
    rates = tensor([[0.0, 0.0, 0.7]])
    for step in range(1, 101):
        t = step * dt
        state = FlightState.at_rest(
            tensor([[0.0, 0.0, -5.0 + 0.5 * GRAVITY * t * t]]), tensor([[0.0, 0.0, 0.7 * t]])
        )
        velocity = tensor([[0.0, 0.0, GRAVITY * t]])
        state = replace(state, velocity=velocity, body_rates=rates)
        found = estimator.update(stream.read(state, np.array([0.0, 0.0, GRAVITY])))
    torch.testing.assert_close(found.velocity, velocity, atol=1e-6, rtol=0)
    torch.testing.assert_close(found.rotation, state.rotation, atol=1e-9, rtol=0)
    torch.testing.assert_close(found.body_rates, rates, atol=1e-9, rtol=0)


def test_gyro_bias_is_found():
    noise = SensorNoise(gyro=0.001, gyro_bias=0.05)
    sensors, still = FlightSensors(noise=noise), Ground.start()
    stream, estimator = SensorStream(sensors, 3), StateEstimator(sensors, 0.01, still)
    rates = [estimator.update(stream.read(still, np.zeros(3))).body_rates for _ in range(4000)]
    assert float(rates[0].abs().max()) > 0.02
    assert float(torch.cat(rates[-500:]).mean(0).abs().max()) < 0.005


def test_pulses_and_thrusts_are_inverse_up_to_the_clamp():
    vehicle = load_design("quadcopter_flight_time").multicopter().detach()  # two sizes
    outputs = MotorOutputs(flight_rotors(vehicle), vehicle.max_thrusts)
    wanted = tensor([2.0, 3.0, 4.0, 1.0])
    for voltage in (12.4, 11.1, 10.2):
        out = outputs.command(wanted, tensor(voltage))
        torch.testing.assert_close(out.thrusts, wanted)
        assert not out.saturated.any()
    low, high = (outputs.command(wanted, tensor(v)).pwm for v in (10.2, 12.4))
    assert bool((low > high).all())
    out = outputs.command(tensor([1.0, 50.0, 1.0, 1.0]), tensor(11.1))
    assert out.saturated.tolist() == [False, True, False, False]
    assert float(out.pwm.max()) <= 1800.0
    # the bench's table of the 10 inch propeller has 5.14 and 5.65 N at 1750 and 1800 us
    strongest = outputs.command(tensor([50.0] * 4), tensor(11.1)).thrusts
    assert float(strongest[2]) == pytest.approx(5.4, abs=0.3)


def test_saturation_is_counted(hovered):
    """A clamp little above the hover's pulses is met on the way up."""
    hovering = hovered.log
    pwm = float(hovering.series("pwm")[-1].max())
    log = quadcopter(sensors=None, pwm_max=pwm + 25.0).run(SHORT)
    assert 0.05 < log.saturated_share.min() <= log.saturated_share.max() < 0.5
    assert log.series("pwm").max() <= pwm + 25.0
    assert log.series("saturated").any() and not hovering.series("saturated").any()


@pytest.mark.reference
def test_load_at_the_limit_takes_all_that_the_clamp_gives():
    """Four equal rotors: a quarter of the weight each is the bench's thrust at 1800 us."""
    vehicle = load_design("x_quadcopter").multicopter().detach()
    rotor = rotor_model("kde2814_10in")
    outputs = MotorOutputs([rotor] * 4, vehicle.max_thrusts)
    limit = payload_limit(vehicle, outputs, PACK)
    each = (vehicle.mass + limit) * GRAVITY / 4.0
    current = PACK.current_for_power(tensor(1.0), 4.0 * rotor.power(each))
    voltage = PACK.voltage(tensor(1.0), current)
    expected = rotor.thrust(rotor.speed_at(1800.0, voltage))
    assert float(each) == pytest.approx(float(expected), rel=1e-4)  # 1e-4 N of the root search


def test_load_beyond_the_limit_is_refused():
    design = load_design("quadcopter")
    with pytest.raises(PayloadError, match=r"must not exceed 0\.9\d\d kg .*1800 us.*got 2 kg") as e:
        FlightSimulator(design, payload=2.0)
    assert 0.9 < e.value.limit < 1.0
    FlightSimulator(design, payload=e.value.limit - 0.01)


@pytest.mark.reference
def test_load_moves_mass_and_inertia():
    """Against the moments of two bodies about a common origin."""
    vehicle = load_design("pentacopter").multicopter().detach()
    J, place = vehicle.inertia, tensor([0.0, 0.0, 0.2])
    eye = torch.eye(3).double()
    two = Moments(
        torch.stack([vehicle.mass, tensor(0.7)]),
        torch.stack([torch.zeros(3).double(), 0.7 * place]),
        torch.stack([0.5 * torch.trace(J) * eye - J, 0.7 * torch.outer(place, place)]),
    )
    mass, center, inertia = rigid_body(two)
    loaded = with_payload(vehicle, 0.7, drop=0.2)
    torch.testing.assert_close(loaded.mass, mass)
    torch.testing.assert_close(loaded.inertia, inertia)
    torch.testing.assert_close(loaded.positions, vehicle.positions - center)


def test_charge_is_current_over_time(flights):
    log = flights["lqr"]
    drawn = log.series("current")[:-1].sum() * 0.01 / float(PACK.capacity)
    assert 1.0 - log.series("charge")[-1] == pytest.approx(drawn, rel=1e-9)
    power = log.series("voltage") * log.series("current")
    wanted = [float(sum(r.power(u) for r, u in zip(TEN_INCH, row, strict=True))) for row in
              log.series("thrusts")[[0, 200, 400]]]  # fmt: skip
    np.testing.assert_allclose(power[[0, 200, 400]], np.array(wanted) + 3.0, rtol=1e-9)


def test_empty_battery_ends_the_flight():
    small = Battery.lipo(cells=3, capacity_mah=5.0)
    with pytest.raises(FlightError, match=r"battery is empty after \d\.\d s"):
        quadcopter(battery=small, sensors=None).run(SHORT)


def test_falling_from_the_sky_is_a_crash(hovered):
    simulator = copy.deepcopy(hovered)
    with pytest.raises(FlightError, match=r"crashed in step \d+: hit the ground at 4\.\d+ m/s"):
        for _ in range(200):  # 1 m of free fall: 4.4 m/s
            simulator.step(Setpoint(position=(0, 0, -1), motors_on=False))


def test_stands_on_the_ground_and_lands():
    mission = mission_from_text(
        "steps:\n  - take_off: {height: 0.5}\n  - yaw: {degrees: 40}\n  - hover: {seconds: 1}\n"
        "  - land: {speed: 0.4}"
    )
    simulator = quadcopter(sensors=None)
    log = simulator.run(mission, seconds=mission.duration + 0.5)
    last = log.samples[-1]
    assert np.all(last.velocity == 0.0) and last.position[2] == 0.0
    assert last.rpy[2] == pytest.approx(np.radians(40.0), abs=0.02)
    assert not last.motors_on and np.all(last.pwm == 1000.0)


def in_a_line():
    """Four rotors along x: no roll."""
    return plus_quadcopter(positions=[[d, 0.0, 0.0] for d in (-0.3, -0.1, 0.1, 0.3)])


@pytest.mark.parametrize(
    ("vehicle", "error", "message"),
    [
        (in_a_line(), HoverError, "command 3 of lift, roll, pitch and yaw"),
        (plus_quadcopter(mass=5.0), HoverError, "no thrusts within the limits hover"),
        (plus_quadcopter(mass=2.9), PayloadError, "does not hover with pulses of 1800 us"),
    ],
)
@pytest.mark.parametrize("controller", ["lqr", "pid"])
def test_what_cannot_fly_is_refused(vehicle, error, message, controller):
    with pytest.raises(error, match=message):
        FlightSimulator(vehicle, rotors=TEN_INCH, controller=controller)


def test_unmeasured_propellers_are_scaled_and_say_so():
    vehicle = load_design("bunny").multicopter().detach()
    rotors = flight_rotors(vehicle)
    scaled = rotors[1]
    assert scaled.name == "kde2814_8in" and "thrust_coefficient" in scaled.assumed
    speed = rotor_model("kde2814_10in").speed(7.2182)
    assert float(scaled.thrust(speed)) == pytest.approx(float(vehicle.max_thrusts[1]), rel=1e-9)
    model = rotor_model("kde2814_10in")
    # momentum theory: power ~ thrust^1.5 / radius, at full thrust of each (offset left out)
    power = [float(r.power(r.max_thrust)) - 11.1 * r.current_offset for r in (scaled, model)]
    expected = (scaled.max_thrust / model.max_thrust) ** 1.5 * 0.127 / 0.1016
    assert power[0] / power[1] == pytest.approx(expected, rel=1e-9)


def test_bad_arguments():
    with pytest.raises(ValueError, match="did you mean 'lqr'"):
        quadcopter(controller="lqg")
    with pytest.raises(ValueError, match="names no rotor models"):
        FlightSimulator(plus_quadcopter())
    with pytest.raises(ValueError, match="one model per rotor, got 3 for 4"):
        FlightSimulator(plus_quadcopter(), rotors=TEN_INCH[:3])
    with pytest.raises(ValueError, match="battery of its own"):
        quadcopter(effects=FlightEffects(battery=PACK.sag(TEN_INCH)))
    with pytest.raises(ValueError, match="pwm_max"):
        quadcopter(pwm_max=2200.0)


def test_wind_gusts_push():
    drag = BodyDrag(linear=tensor([0.3] * 3), quadratic=tensor([0.0] * 3))
    wind = torch.zeros(600, 3).double()
    wind[300:, 1] = 3.0
    log = quadcopter(sensors=None, effects=FlightEffects(body_drag=drag, wind=wind)).run(
        SHORT, seconds=4.5
    )
    east = log.series("position")[:, 1]
    assert np.abs(east[:300]).max() < 1e-9 and east[300:].max() > 0.02
