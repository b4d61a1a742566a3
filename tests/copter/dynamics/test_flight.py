"""Flights against closed forms, conservation, order of convergence and the public tool."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch.utils._python_dispatch import TorchDispatchMode

from diffsim.copter import GRAVITY
from diffsim.copter.dynamics.flight import Feedback, FlightError, fly
from diffsim.copter.dynamics.flight_state import FlightState
from diffsim.copter.vehicle.effects import (
    BodyDrag,
    FlightEffects,
    GroundEffect,
    Interference,
    MotorLag,
    RotorDrag,
    ThrustCurve,
)
from diffsim.core.rotation import (
    matrix_from_quaternion,
    quaternion_from_rpy,
    rpy_rates_from_body_rates,
)
from tests.copter.flight_cases import all_effects, crooked_copter, tensor, tumbling
from tests.copter.vehicle.test_vehicle import NAMES, from_reference, plus_quadcopter, reference


def still(batch=1):
    return FlightState.at_rest(torch.zeros(batch, 3, dtype=torch.float64))


def constant(thrusts, steps):
    return tensor(thrusts).expand(1, steps, -1)


def momentum_and_energy(vehicle, state):
    spin = state.body_rates @ vehicle.inertia
    world = (state.rotation @ spin[..., None])[..., 0]
    return world, 0.5 * (spin * state.body_rates).sum(-1)


@pytest.mark.reference
def test_free_fall():
    start = replace(tumbling(3), thrusts=None)
    flight = fly(crooked_copter(), start, constant([0.0] * 5, 20), dt=0.05)
    t = flight.time[:, None]
    g = tensor([0.0, 0.0, GRAVITY])
    expected = start.position[:, None] + start.velocity[:, None] * t + 0.5 * g * t**2
    torch.testing.assert_close(flight.state.position, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.reference
def test_constant_thrust():
    """Straight up at (4 u / m - g), and level thrust of a tilted one."""
    flight = fly(plus_quadcopter(), still(), constant([4.0] * 4, 10), dt=0.1)
    expected = 0.5 * (GRAVITY - 16.0 / 1.2) * flight.time**2
    torch.testing.assert_close(flight.state.position[0, :, 2], expected, rtol=1e-12, atol=1e-12)

    pitched = FlightState.at_rest(torch.zeros(1, 3).double(), tensor([[0.0, -np.pi / 6, 0.0]]))
    flight = fly(plus_quadcopter(), pitched, constant([4.0] * 4, 10), dt=0.1)
    across = 0.5 * (16.0 / 1.2) * np.sin(np.pi / 6)  # nose down flies north
    assert float(flight.state.position[0, -1, 0]) == pytest.approx(across, rel=1e-12)


@pytest.mark.reference
def test_spin_up_about_yaw():
    """A pair of equal spins twists with sum(b lambda u) = J_z w'."""
    flight = fly(plus_quadcopter(), still(), constant([3.0, 1.0, 3.0, 1.0], 10), dt=0.02)
    # up is -z, so a positive spin turns the body about -z
    rate = -0.0147 * 4.0 / 0.04 * 0.2
    assert float(flight.state.body_rates[0, -1, 2]) == pytest.approx(rate, rel=1e-12)
    assert float(flight.state.rpy[0, -1, 2]) == pytest.approx(0.5 * rate * 0.2, rel=1e-9)


@pytest.mark.order
def test_torque_free_rotation_conserves():
    """Angular momentum and energy drift at the order of the integrator; |q| stays one."""
    vehicle, start = crooked_copter(), replace(tumbling(2), thrusts=None)
    start = replace(start, body_rates=5.0 * start.body_rates)
    drift = {"momentum": [], "energy": []}
    steps = [25, 50, 100]
    for count in steps:
        flight = fly(vehicle, start, constant([0.0] * 5, count), dt=1.0 / count)
        momentum, energy = momentum_and_energy(vehicle, flight.state)
        drift["momentum"].append((momentum[:, -1] - momentum[:, 0]).norm().item())
        drift["energy"].append((energy[:, -1] - energy[:, 0]).abs().max().item())
        norm = flight.state.quaternion.norm(dim=-1)
        torch.testing.assert_close(norm, torch.ones_like(norm), rtol=0, atol=1e-14)
    for name, values in drift.items():
        order = -np.polyfit(np.log(steps), np.log(values), 1)[0]
        assert order > 3.8, (name, values)  # quadratic invariants may drift at order five


@pytest.mark.order
def test_order_of_convergence():
    """Slope of the error against a fine solution, all effects on, clear of the ground's kink."""
    vehicle, start = crooked_copter(), tumbling()
    start = replace(start, position=start.position - tensor([0.0, 0.0, 1.5]))
    commands = tensor(np.random.default_rng(0).uniform(2.5, 4, (2, 4, 5)))

    def end(substeps):
        state = fly(
            vehicle, start, commands, dt=0.1, effects=all_effects(), substeps=substeps
        ).state
        return torch.cat([state.position, state.quaternion, state.velocity, state.body_rates], -1)[
            :, -1
        ]

    fine = end(256)
    counts = np.array([4, 8, 16])
    errors = [(end(int(k)) - fine).abs().max().item() for k in counts]
    slope = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert slope == pytest.approx(4.0, abs=0.25), errors


@pytest.mark.reference
def test_all_effects_against_scipy():
    """The equations written anew with rotation matrices in numpy, solved by DOP853."""
    vehicle, start, effects = crooked_copter(), tumbling(1), all_effects(steps=3)
    commands = tensor(np.random.default_rng(1).uniform(2.5, 4, (1, 3, 5)))
    flight = fly(vehicle, start, commands, dt=0.05, effects=effects, substeps=50)
    y = np.concatenate(
        [
            start.position[0],
            flight.state.rotation[0, 0].flatten(),
            start.velocity[0],
            start.body_rates[0],
            start.thrusts[0],
            start.charge,
        ]
    )
    for step in range(3):
        slope = numpy_model(vehicle, effects, commands[0, step].numpy(), effects.wind[step].numpy())
        y = solve_ivp(slope, (0, 0.05), y, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    s = flight.state
    got = [s.position, s.rotation.flatten(-2), s.velocity, s.body_rates, s.thrusts]
    got = torch.cat([*(g[0, -1] for g in got), s.charge[0, -1:]])
    np.testing.assert_allclose(got.numpy(), y, rtol=1e-8, atol=1e-8)  # RK4 at 1 ms


def numpy_model(vehicle, effects, command, wind):
    m, J = float(vehicle.mass), vehicle.inertia.numpy()
    arms, axes = vehicle.positions.numpy(), vehicle.directions.numpy()
    twist = (vehicle.spins * vehicle.torque_ratios).numpy()
    lag, curve, sag = effects.motor_lag, effects.thrust_curve, effects.battery
    ground, drag = effects.ground_effect, effects.body_drag

    def slope(_, y):
        p, R, v, w, s, charge = y[:3], y[3:12].reshape(3, 3), y[12:15], y[15:18], y[18:23], y[23]
        current = float(sag.idle_current) + np.sum(
            sag.current_coefficients.numpy() * s ** sag.current_exponents.numpy()
        )
        voltage = np.polynomial.polynomial.polyval(charge, sag.open_circuit.numpy())
        voltage -= float(sag.resistance) * current
        ref = curve.reference_thrusts.numpy()
        bench = ref * (s / ref) ** curve.exponents.numpy()
        bench = bench * (voltage / float(sag.nominal_voltage)) ** float(sag.exponent)
        thrust = (np.eye(5) - effects.interference.losses.numpy()) @ bench
        height = -(p + (R @ arms.T).T)[:, 2] - float(ground.terrain_height)
        near = (vehicle.radii.numpy() / (4 * height)) ** 2
        thrust = thrust / (1 - float(ground.coefficient) * near)
        air = R.T @ (v - wind)
        force = -(drag.linear.numpy() + drag.quadratic.numpy() * np.linalg.norm(air)) * air
        torque = np.zeros(3)
        for i in range(5):
            hub = air + np.cross(w, arms[i])
            hub = hub - axes[i] * (axes[i] @ hub)
            one = thrust[i] * (axes[i] - float(effects.rotor_drag.coefficient) * hub)
            force = force + one
            torque += np.cross(arms[i], one) + twist[i] * bench[i] * axes[i]
        skew = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate(
            [
                v,
                (R @ skew).ravel(),
                np.array([0, 0, GRAVITY]) + R @ force / m,
                np.linalg.solve(J, torque - np.cross(w, J @ w)),
                (command - s) / lag.time_constants.numpy(),
                [-current / float(sag.capacity)],
            ]
        )

    return slope


@pytest.mark.reference
@pytest.mark.parametrize("name", NAMES)
def test_public_tool_at_1000_hz(name):
    """The tool steps by explicit Euler (see below); ours is nearer to the truth than its error."""
    facts = reference(name)
    rows, ours = tool_flight(facts, 1000)
    tool = tensor(rows)[:, 1:4]
    difference = (ours - tool).abs().max().item()
    finer = (tool_flight(facts, 1000, substeps=4)[1] - ours).abs().max().item()
    # both hold the command for a period; what is left is the tool's first-order error
    assert difference < 2e-4
    assert finer < 1e-8
    coarse_rows, coarse = tool_flight(facts, 30)
    coarse_difference = (coarse - tensor(coarse_rows)[:, 1:4]).abs().max().item()
    order = np.log(coarse_difference / difference) / np.log(1000 / 30)
    assert order == pytest.approx(1.0, abs=0.05)


def tool_flight(facts, hertz, substeps=1):
    key = f"sim_{hertz}Hz_10s"
    rows = np.array(facts[key]["traj_t_xyz_rpy"])
    target = tensor(facts["trim_x"])
    target[2] = -0.75
    flight = fly(
        from_reference(facts),
        FlightState.at_rest(tensor([facts["com_world"]])),  # where the tool's copters stand
        constant(facts["trim_u"], 10 * hertz),
        dt=1.0 / hertz,
        feedback=Feedback(gain=tensor(facts["K"]), reference=target),
        substeps=substeps,
    )
    at = np.rint(rows[:, 0] * hertz).astype(int)
    return rows, flight.state.position[0, at]


@pytest.mark.reference
@pytest.mark.parametrize("name", NAMES)
def test_public_tool_is_explicit_euler(name):
    """Explicit Euler on position, angles, world velocity and body rates gives its file exactly.

    2 s at 30 Hz; the pentacopter's file holds fewer digits of trim (1e-5 m).
    """
    facts = reference(name)
    vehicle = from_reference(facts)
    target = tensor(facts["trim_x"])
    target[2] = -0.75
    gain, trim, h = tensor(facts["K"]), tensor(facts["trim_u"]), 1.0 / 30
    p, rpy = tensor(facts["com_world"]), torch.zeros(3, dtype=torch.float64)
    v, w = torch.zeros(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    path = {}
    for step in range(1, 61):
        state = FlightState(p[None], quaternion_from_rpy(rpy)[None], v[None], w[None])
        x12 = state.minimal()[0]
        u = torch.minimum((trim - gain @ (x12 - target)).clamp(min=0.0), vehicle.max_thrusts)
        force = state.rotation[0] @ (vehicle.force_matrix @ u)
        torque = vehicle.torque_matrix @ u - torch.linalg.cross(w, vehicle.inertia @ w)
        p, rpy = p + h * v, rpy + h * rpy_rates_from_body_rates(rpy, w)
        v = v + h * (tensor([0, 0, GRAVITY]) + force / vehicle.mass)
        w = w + h * torch.linalg.solve(vehicle.inertia, torque)
        path[step] = torch.cat([p, rpy])
    for row in facts["sim_30Hz_10s"]["traj_t_xyz_rpy"][:4]:
        expected = tensor(row[1:])
        torch.testing.assert_close(path[round(row[0] * 30)], expected, rtol=0, atol=1e-5)


@pytest.mark.property
def test_batch_is_many_single_flights():
    """Lanes do not mix, whatever the batch's remainder and the number of threads."""
    vehicle, start = crooked_copter(), tumbling(19)
    commands = tensor(np.random.default_rng(3).uniform(2.5, 4, (19, 4, 5)))
    many = fly(vehicle, start, commands, dt=0.02, effects=all_effects(), num_threads=2).state
    for i in (0, 7, 18):
        one = FlightState(*(getattr(start, f.name)[i : i + 1] for f in fields(start)))
        alone = fly(vehicle, one, commands[i : i + 1], dt=0.02, effects=all_effects()).state
        for f in fields(start):
            assert torch.equal(getattr(many, f.name)[i], getattr(alone, f.name)[0])


@pytest.mark.property
def test_a_negative_thrust_is_one_the_other_way():
    """Without the clamp a rotor pushes back as one that points the other way pushes."""
    vehicle, commands = crooked_copter(), tensor(np.full((1, 4, 5), 3.0))
    commands[..., 1], commands[..., 3] = -2.0, 50.0
    directions, limits = vehicle.directions.clone(), vehicle.max_thrusts.clone()
    directions[1] *= -1.0
    limits[3] = 60.0
    turned = vehicle.replace(directions=directions, max_thrusts=limits)
    drag = FlightEffects(body_drag=all_effects().body_drag)
    free = fly(vehicle, tumbling(1), commands, dt=0.02, effects=drag, clamp=False).state
    want = fly(turned, tumbling(1), commands.abs(), dt=0.02, effects=drag).state
    for name in ("position", "velocity", "quaternion", "body_rates"):
        torch.testing.assert_close(getattr(free, name), getattr(want, name), rtol=0, atol=1e-12)


def test_powers_of_thrusts_need_the_clamp():
    commands = tensor(np.full((1, 4, 5), 3.0))
    with pytest.raises(ValueError, match=r"effects\.battery takes a power"):
        fly(crooked_copter(), tumbling(1), commands, dt=0.02, effects=all_effects(), clamp=False)


@pytest.mark.property
def test_yaw_does_not_matter_to_physics():
    """Turning start and wind about the vertical turns the flight."""
    vehicle, start = crooked_copter(), tumbling(1)
    turn = tensor([np.cos(0.6), 0, 0, np.sin(0.6)])
    R = matrix_from_quaternion(turn)
    a, b = turn, start.quaternion[0]
    product = torch.cat(
        [
            (a[0] * b[0] - a[1:] @ b[1:])[None],
            a[0] * b[1:] + b[0] * a[1:] + torch.linalg.cross(a[1:], b[1:]),
        ]
    )
    turned = replace(
        start,
        position=start.position @ R.T,
        velocity=start.velocity @ R.T,
        quaternion=product[None],
    )
    effects = all_effects()
    commands = constant([3.0, 3.2, 2.8, 3.1, 2.9], 4)
    plain = fly(vehicle, start, commands, dt=0.05, effects=effects).state
    windy = replace(effects, wind=effects.wind @ R.T)
    other = fly(vehicle, turned, commands, dt=0.05, effects=windy).state
    torch.testing.assert_close(other.position, plain.position @ R.T, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(other.rotation, R @ plain.rotation, rtol=1e-12, atol=1e-12)


@pytest.mark.reference
def test_terminal_velocity_and_wind():
    """Falling with linear drag: v = (m g / D)(1 - exp(-D t / m)); at rest in wind alike."""
    drag = BodyDrag(linear=tensor([0.5] * 3), quadratic=tensor([0.0] * 3))
    effects = FlightEffects(body_drag=drag, wind=tensor([2.0, 0.0, 0.0]))
    flight = fly(plus_quadcopter(), still(), constant([0.0] * 4, 40), dt=0.05, effects=effects)
    decay = 1 - torch.exp(-0.5 * flight.time / 1.2)
    expected = torch.stack([2.0 * decay, 0 * decay, 1.2 * GRAVITY / 0.5 * decay], -1)
    torch.testing.assert_close(flight.state.velocity[0], expected, rtol=1e-7, atol=1e-7)


@pytest.mark.reference
def test_lag_curve_interference_ground():
    """Each against its formula in the first instants."""
    lag = FlightEffects(motor_lag=MotorLag(time_constants=tensor([0.05] * 4)))
    start = replace(still(), thrusts=tensor([[1.0] * 4]))
    flight = fly(plus_quadcopter(), start, constant([3.0] * 4, 10), dt=0.02, effects=lag)
    expected = 3.0 - 2.0 * torch.exp(-flight.time / 0.05)
    torch.testing.assert_close(flight.state.thrusts[0, :, 0], expected)

    def lift(effects, height=1.0, command=3.0):
        start = FlightState.at_rest(tensor([[0.0, 0.0, -height]]))
        flown = fly(plus_quadcopter(), start, constant([command] * 4, 1), dt=1e-5, effects=effects)
        return 1.2 * (GRAVITY - float(flown.state.velocity[0, 1, 2]) / 1e-5)

    curve = ThrustCurve(exponents=tensor([1.06] * 4), reference_thrusts=tensor([4.0] * 4))
    assert lift(FlightEffects(thrust_curve=curve)) == pytest.approx(16 * 0.75**1.06, rel=1e-9)
    losses = torch.zeros(4, 4, dtype=torch.float64)
    losses[0, 1] = 0.2
    assert lift(FlightEffects(interference=Interference(losses=losses))) == pytest.approx(11.4)
    ground = GroundEffect(coefficient=tensor(1.0), terrain_height=tensor(0.8))
    factor = 1 / (1 - (0.127 / (4 * 0.2)) ** 2)
    assert lift(FlightEffects(ground_effect=ground)) == pytest.approx(12 * factor, rel=1e-6)
    buried = lift(FlightEffects(ground_effect=ground), height=0.0)  # counts as half a radius
    assert buried == pytest.approx(12 / (1 - 0.25), rel=1e-6)


@pytest.mark.property
def test_drag_takes_energy():
    """In still air at zero gravity's expense: less energy than without drag, no change at rest."""
    rotor = FlightEffects(rotor_drag=RotorDrag(coefficient=tensor(0.05)))
    start = replace(still(), velocity=tensor([[3.0, 0.0, 0.0]]))
    flight = fly(plus_quadcopter(), start, constant([2.943] * 4, 20), dt=0.02, effects=rotor)
    speed = flight.state.velocity[0, :, 0]
    assert bool((speed.diff() < 0).all())
    # hubs of a level rotor lose k T v: v' = -k g v in hover (tilt by flapping torque left aside)
    assert float(speed[1] - speed[0]) / 0.02 == pytest.approx(-0.05 * 9.81 * 3.0, rel=0.02)


def test_state_of_twelve_there_and_back():
    x12 = tensor(np.random.default_rng(4).normal(0, 0.4, (6, 12)))
    torch.testing.assert_close(FlightState.from_minimal(x12).minimal(), x12)


def test_feedback_takes_the_short_way():
    """A heading of -179 degrees is 2 degrees from one of 179, not 358."""
    gain = torch.zeros(4, 12, dtype=torch.float64)
    gain[:, 5] = 1.0
    start = FlightState.at_rest(torch.zeros(1, 3).double(), tensor([[0, 0, np.deg2rad(-179.0)]]))
    target = torch.zeros(12, dtype=torch.float64)
    target[5] = np.deg2rad(179.0)
    flight = fly(
        plus_quadcopter(),
        start,
        constant([3.0] * 4, 1),
        dt=0.01,
        feedback=Feedback(gain=gain, reference=target),
    )
    expected = 3.0 - np.deg2rad(2.0)
    torch.testing.assert_close(flight.state.thrusts[0, 1], tensor([expected] * 4))


class Called(TorchDispatchMode):
    """Names of the torch operations of a block."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.names = [*getattr(self, "names", []), func.__name__]
        return func(*args, **(kwargs or {}))


def test_a_state_is_a_view_of_its_flight():
    """No field is copied, not even to be looked at; a wrong one is refused all the same."""
    state = fly(crooked_copter(), still(2), constant([3.0] * 5, 3), dt=0.01).state
    assert not state.velocity.is_contiguous()
    with Called() as called:
        again = replace(state)
    assert not getattr(called, "names", [])
    assert again.velocity is state.velocity
    with pytest.raises(ValueError, match=r"velocity must have shape \(2, 4, 3\)"):
        replace(state, velocity=state.velocity[:, 1:])
    with pytest.raises(TypeError, match=r"velocity must be torch\.float64"):
        replace(state, velocity=state.velocity.float())


def test_bad_input():
    vehicle, commands = plus_quadcopter(), constant([3.0] * 4, 5)
    with pytest.raises(ValueError, match="commands must have shape"):
        fly(vehicle, still(), constant([3.0] * 5, 5), dt=0.01)
    with pytest.raises(ValueError, match="batch sizes disagree: start 3, commands 2"):
        fly(vehicle, still(3), commands.expand(2, -1, -1), dt=0.01)
    with pytest.raises(ValueError, match="steps sizes disagree"):
        drag = BodyDrag(linear=tensor([0.1] * 3), quadratic=tensor([0.1] * 3))
        effects = FlightEffects(body_drag=drag, wind=torch.zeros(4, 3, dtype=torch.float64))
        fly(vehicle, still(), commands, dt=0.01, effects=effects)
    with pytest.raises(ValueError, match="wind acts through drag"):
        FlightEffects(wind=tensor([1.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match="equal rotor counts"):
        fly([vehicle, crooked_copter()], still(2), commands, dt=0.01)
    for num in (3, 0):
        lag = MotorLag(time_constants=tensor([0.05] * num))
        with pytest.raises(ValueError, match="lag_decay needs 4 values per vehicle"):
            fly(vehicle, still(), commands, dt=0.01, effects=FlightEffects(motor_lag=lag))
    with pytest.raises(ValueError, match="quaternion must not be zero"):
        fly(vehicle, replace(still(), quaternion=torch.zeros(1, 4).double()), commands, dt=0.01)


def test_the_end_alone_is_the_end_of_the_path():
    """Whole registers and parts of one, shared starts, one step and none."""
    for batch, steps in ((1, 1), (8, 5), (11, 5)):
        commands = constant([3.0] * 5, steps) + torch.arange(batch)[:, None, None]
        start = replace(tumbling(1), thrusts=None)
        path, end = (
            fly(crooked_copter(), start, commands, dt=0.01, effects=all_effects(5, steps), keep=k)
            for k in ("path", "end")
        )
        assert end.state.position.shape == (batch, 1, 3)
        assert torch.equal(end.time, path.time[-1:])
        for name, value in vars(end.state).items():
            assert torch.equal(value, getattr(path.state, name)[:, -1:])
    nowhere = fly(crooked_copter(), tumbling(2, 5), constant([3.0] * 5, 0), dt=0.01, keep="end")
    assert torch.equal(nowhere.state.position[:, 0], tumbling(2, 5).position)
    with pytest.raises(ValueError, match="keep must be one of"):
        fly(crooked_copter(), still(), constant([3.0] * 5, 2), dt=0.01, keep="last")


@pytest.mark.parametrize("keep", ["path", "end"])
def test_a_flight_that_blows_up_is_reported(keep):
    gain = 1e200 * torch.ones(4, 12, dtype=torch.float64)
    start = replace(still(2), body_rates=tensor([[0.0] * 3, [1e200] * 3]))
    with pytest.raises(FlightError, match="vehicle 1 has no finite state after step 1"):
        fly(
            plus_quadcopter(),
            start,
            constant([3.0] * 4, 5),
            dt=0.01,
            feedback=Feedback(gain=gain, reference=torch.zeros(12, dtype=torch.float64)),
            keep=keep,
        )
