"""Moments of air and rotors against their formulas, in the model's frames (z down)."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import torch

from diffsim.causes.scene import Commands
from diffsim.copter.dynamics import flight
from diffsim.copter.vehicle.multicopter import Fleet
from diffsim.systems.multicopter import readings
from diffsim.systems.multicopter.motion import FlightMotion
from diffsim.systems.multicopter.scene import CopterScene, Flyer, flight_grid, rotor_names
from diffsim.systems.multicopter.unknown import unknown_wrench
from tests.systems.test_multicopter import CAUSES, quadcopter

f64 = torch.float64
THRUSTS = torch.tensor([2.0, 2.5, 1.0, 1.5], dtype=f64)
COEFFICIENT = 1e-5
FLOW_MOMENT, CLIMB_MOMENT, RATE_DAMPING, SPIN_UP = (
    CAUSES[name] for name in ("flow_moment", "climb_moment", "rate_damping", "spin_up")
)


def rows(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=f64).expand(1, 1, 5, -1)


def torque_of(effect, size, *, velocity=(0.0, 0.0, 0.0), rates=(0.0, 0.0, 0.0), asked=None):
    """Torque and lift that an effect adds, (5, 3) and (5,)."""
    vehicle = quadcopter()
    fleet = Fleet.of([vehicle])
    thrusts = THRUSTS.expand(1, 1, 5, -1)
    scene = SimpleNamespace(vehicle=fleet, thrust_coefficient=COEFFICIENT, dt=0.01)
    scene.with_schedule = lambda change: change
    level = torch.eye(3, dtype=f64).expand(1, 1, 5, 3, 3)
    asked = thrusts if asked is None else asked
    motion = FlightMotion(
        fleet, rows(0, 0, 0), rows(*velocity), level, rows(*rates), thrusts, asked, rows(0, 0, 0)
    )
    change = effect.apply(scene, torch.tensor(size, dtype=f64), None)
    more = (change(motion, thrusts) - thrusts)[0, 0]
    return (more @ vehicle.torque_matrix.T).numpy(), more.sum(-1).numpy()


def test_flow_moment_is_that_of_a_drag_above_the_center():
    velocity = np.array([1.2, -0.7, 0.4])
    got, lift = torque_of(FLOW_MOMENT, [0.03, 0.03], velocity=velocity)
    want = np.cross([0.0, 0.0, -1.0], -0.03 * velocity)  # one meter up, force against the motion
    np.testing.assert_allclose(got, np.tile(want, (5, 1)), atol=1e-12)
    np.testing.assert_allclose(lift, 0.0, atol=1e-12)


def test_a_climb_takes_from_the_flow_moment():
    sinking = torque_of(CLIMB_MOMENT, [0.01, 0.01], velocity=(1.0, 0.5, 2.0))[0]
    rising = torque_of(CLIMB_MOMENT, [0.01, 0.01], velocity=(1.0, 0.5, -2.0))[0]
    flow = torque_of(FLOW_MOMENT, [0.02, 0.02], velocity=(1.0, 0.5, 0.0))[0]
    np.testing.assert_allclose(rising, -flow, atol=1e-12)
    np.testing.assert_allclose(sinking, flow, atol=1e-12)


def test_rates_fall_by_the_damping_alone():
    sizes, rates = np.array([1.0, 2.0, 0.5]), np.array([0.3, -0.4, 0.8])
    got, _ = torque_of(RATE_DAMPING, sizes.tolist(), rates=rates)
    inertia = quadcopter().inertia.numpy()
    np.testing.assert_allclose(np.linalg.solve(inertia, got[0]), -sizes * rates, atol=1e-12)


def test_rotors_that_speed_up_turn_the_vehicle_the_other_way():
    inertia, gained = 1e-4, 30.0  # [kg m^2], [rad/s] per step
    speeds = torch.full((5, 4), 400.0, dtype=f64)
    speeds[:, 0] += gained * torch.arange(5)
    asked = (COEFFICIENT * speeds**2)[None, None]
    got, lift = torque_of(SPIN_UP, [inertia], asked=asked)
    # the torque of the air on rotor 1 has the same sense as that of its gaining speed
    sense = np.sign(float(quadcopter().torque_matrix[2, 0]))
    want = [0.0, 0.0, sense * inertia * gained / 0.01]
    np.testing.assert_allclose(got, np.tile(want, (5, 1)), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(lift, 0.0, atol=1e-9)


def damped_flight(sensors=("body_rates",), **options):
    """A flight in which yaw is damped, and where it starts: 20 steps of 0.02 s from 2 rad/s."""
    dt, steps, rate = 0.02, 20, 2.0
    vehicle = quadcopter()
    weak = replace(Fleet.of([vehicle]), torque_ratios=torch.full((1, 4), 1e-4, dtype=f64))
    scene = CopterScene(
        fleet=weak,
        commands=Commands.named(rotor_names(4), torch.full((1, 4, steps), 9.81 / 4, dtype=f64)),
        grid=flight_grid(steps, dt),
        sensors=sensors,
        windows=SimpleNamespace(measured=torch.zeros(1, steps, 3 * len(sensors), dtype=f64)),
        substeps=4,
        **options,
    )
    damped = RATE_DAMPING.apply(scene, torch.tensor([0.0, 0.0, 5.0], dtype=f64), None)
    start = torch.zeros(1, 1, 16, dtype=f64)
    start[..., 11], start[..., 12:] = rate, 9.81 / 4
    return damped, start


def test_a_moment_beyond_what_the_rotors_could_give_acts_in_full():
    """Yaw falls by exp(-5 t), though rotors with this torque could not hold a hundredth of it."""
    dt, steps, rate = 0.02, 20, 2.0
    damped, start = damped_flight()
    with torch.no_grad():
        found = Flyer(damped, 1)(start)[0, 0, :, 2]
    want = rate * torch.exp(-5.0 * dt * torch.arange(1, steps + 1, dtype=f64))
    np.testing.assert_allclose(found, want, rtol=2e-2)


def test_vehicles_are_packed_once_for_all_passes(monkeypatch):
    packed, passes = [], []
    rows, rollout = flight.parameter_rows, Flyer._fly
    monkeypatch.setattr(flight, "parameter_rows", lambda *a: packed.append(a) or rows(*a))
    monkeypatch.setattr(Flyer, "_fly", lambda *a: passes.append(a) or rollout(*a))
    damped, start = damped_flight()
    with torch.no_grad():
        Flyer(damped, 1)(start)
    assert len(passes) > 1
    assert len(packed) == 1


def test_a_late_sensor_reads_no_others_again(monkeypatch):
    read, groups = [], dict(readings._GROUPS)
    for name, group in groups.items():
        seen = partial(lambda shown, name, group: read.append(name) or group(shown), name=name)
        monkeypatch.setitem(readings._GROUPS, name, partial(seen, group=group))
    sensors = ("position", "velocity", "body_rates")
    damped, start = damped_flight(sensors)
    delay = torch.tensor([0.01], dtype=f64)
    with torch.no_grad():
        plain = Flyer(damped, 1)(start)
        read.clear()
        late = Flyer(damped.with_clock((7, 8), delay), 1)(start)
    assert read == [*sensors, "body_rates"]
    torch.testing.assert_close(late[..., :7], plain[..., :7], atol=0, rtol=0)
    assert float((late - plain)[..., 8].abs().min()) > 0.01


def test_an_unknown_force_is_the_mean_over_each_step():
    """A ramp in time, as the mean of a line over a step is its value in the middle of it."""
    vehicle, dt, count = Fleet.of([quadcopter()]), 0.02, 40
    scene = SimpleNamespace(vehicle=vehicle, dt=dt, num_samples=count)
    scene.world_force = torch.zeros(1, count, 3, dtype=f64)
    scene.changed = lambda world_force: SimpleNamespace(
        with_command=lambda names, change: (world_force, change)
    )
    force = unknown_wrench(9, 0.8)
    knots = torch.linspace(0.0, 0.8, 9, dtype=f64)
    size = torch.cat([knots, 2.0 * knots, -knots, 3.0 * knots, 0.0 * knots, 4.0 * knots])
    push, change = force.apply(scene, size, None)
    middle = dt * (np.arange(count) + 0.5)
    np.testing.assert_allclose(push[0], np.outer(middle, [1.0, 2.0, -1.0]), atol=1e-12)
    thrusts = change(torch.zeros(1, 4, count + 1, dtype=f64), None)[0].T
    torque = thrusts[1:] @ quadcopter().torque_matrix.T  # the first step lies before the record
    np.testing.assert_allclose(torque, 0.02 * np.outer(middle, [3.0, 0.0, 4.0]), atol=1e-12)
