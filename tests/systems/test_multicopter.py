"""Multicopter bed: effects have right scores, and act as physics says."""

import pickle
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from diffsim import copter
from diffsim.causes.listing import list_causes
from diffsim.copter import GRAVITY
from diffsim.copter.vehicle.multicopter import Fleet
from diffsim.core.errors import ConvergenceError
from diffsim.core.rotation import matrix_from_rpy
from diffsim.core.schema import read_part
from diffsim.data.study import Channel, Run, Study
from diffsim.identify import Numerics, coarse
from diffsim.systems.multicopter import CopterModel, copter_plant, unknown_wrench
from diffsim.systems.multicopter.assembly import assembled
from diffsim.systems.multicopter.description import MulticopterDescription
from diffsim.systems.multicopter.motion import FlightMotion
from diffsim.systems.multicopter.scene import Flyer
from diffsim.systems.multicopter.shooting import MAX_STEPS, SPREAD, FlightShooting, Windows
from labs.systems.copter import causes
from tests.diagnose.gate import score_error

DT, SAMPLES = 0.02, 110
NAMES = ["u0", "u1", "u2", "u3"]
SD = torch.tensor(np.repeat([2e-3, 5e-3, 1e-2, 0.1], 3))
HOVER = GRAVITY / 4
EFFECTS = causes()
UNITS = {"position": "m", "roll_pitch_yaw": "rad", "body_rates": "rad/s", "specific_force": "m/s^2"}
SENSORS = {key: [f"{key}_{i}" for i in range(3)] for key in UNITS}
CHANNELS = [Channel(name, UNITS[key], "any") for key, names in SENSORS.items() for name in names]
MOTORS = {
    "torque_gain": {"value": 1.0, "percent": 20.0},
    "motor_lag": {"value": 0.03, "percent": 30.0},
}
HELD = {"thrust_gain": 1.0, "inertia_gain": 1.0}


def tensor(value):
    return torch.as_tensor(np.asarray(value), dtype=torch.float64)


def size(*values):
    return tensor(values)


def causes_with(*facts):
    """Causes of a quadcopter by name."""
    return {e.name: e for e in list_causes(copter_plant(4, 1.0, 0.25, facts))}


CAUSES = {
    **causes_with("sees_position", "sees_velocity", "speeds"),
    **{e.name: e for e in EFFECTS},
    "battery_sag": causes_with()["battery_sag"],
}


def quadcopter():
    a = 0.2
    return copter.Multicopter(
        mass=tensor(1.0),
        inertia=torch.diag(tensor([0.01, 0.012, 0.02])),
        positions=tensor([[a, a, 0], [-a, -a, 0], [a, -a, 0], [-a, a, 0]]),
        directions=tensor([[0, 0, -1.0]] * 4),
        spins=tensor([1.0, 1.0, -1.0, -1.0]),
        torque_ratios=tensor([0.015] * 4),
        max_thrusts=tensor([8.0] * 4),
        radii=tensor([0.12] * 4),
    )


def model_of(*runs, commands=NAMES, **keys):
    """The quadcopter as described, its thrust and inertia fitted unless keys say otherwise."""
    vehicle = quadcopter()
    described = {
        "system": "multicopter",
        "frames": {"world": "NED", "body": "FRD"},
        "mass": float(vehicle.mass),
        "inertia": vehicle.inertia.diagonal().tolist(),
        "rotors": [
            {"at": at, "spin": "cw" if spin > 0 else "ccw"}
            for at, spin in zip(vehicle.positions.tolist(), vehicle.spins, strict=True)
        ],
        "torque_ratio": 0.015,
        "torque_gain": 1.0,
        "radius": 0.12,
        "max_thrust": 8.0,
        "commands": {"columns": commands, "as": "thrust"},
        "sensors": SENSORS,
        "nuisances": {"run_thrust_gain": 0, "attitude_offset": 0, "specific_force_offset": 0},
        **keys,
    }
    study = Study("s", "multicopter", CHANNELS, runs)
    flights = assembled(read_part(MulticopterDescription, described, "model"), study)
    return CopterModel(flights, flights.parameters.base)


@pytest.fixture(scope="module")
def flown():
    """A closed-loop flight about with turns, its thrusts and noise-free channels."""
    vehicle, eye = quadcopter(), torch.eye
    linear = copter.linearize(vehicle, tensor([HOVER] * 4), torch.zeros(2, dtype=torch.float64))
    weight = eye(12, dtype=torch.float64)
    gain = copter.lqr(linear.A, linear.B, weight, eye(4, dtype=torch.float64)).K
    t = DT * torch.arange(SAMPLES, dtype=torch.float64)
    aim = torch.zeros(SAMPLES, 12, dtype=torch.float64)
    aim[:, 0], aim[:, 1] = 1.5 * torch.sin(2 * t), torch.cos(1.5 * t) - 1
    aim[:, 2], aim[:, 5] = -0.6 + 0.3 * torch.sin(3 * t), 0.4 * t
    flight = copter.fly(
        vehicle,
        copter.FlightState.at_rest(tensor([[0.0, 0.0, -0.6]])),
        tensor([HOVER] * 4).expand(1, SAMPLES, 4).contiguous(),
        dt=DT,
        substeps=4,
        feedback=copter.Feedback(gain=gain, reference=aim),
    )
    state, thrusts = flight.state, flight.state.thrusts[0, 1:]
    assert float(thrusts.min()) > 0.1 and float(thrusts.max()) < 7.9  # bounds are kinks
    steps = state.velocity.diff(dim=1) / DT  # the mean over the step before
    acceleration = torch.cat([steps[:, :1], steps], 1) - tensor([0, 0, GRAVITY])
    halfway = 0.5 * (state.rotation[:, 1:] + state.rotation[:, :-1])  # of the step before
    halfway = torch.cat([halfway[:, :1], halfway], 1)
    specific = (halfway.mT @ acceleration[..., None])[..., 0]
    channels = torch.cat([state.position, state.rpy, state.body_rates, specific], -1)[0, :SAMPLES]
    command = {name: thrusts[:, i].numpy() for i, name in enumerate(NAMES)}
    command["voltage_V"] = np.linspace(12.0, 11.0, SAMPLES)
    rng = np.random.default_rng(0)
    measured = channels.numpy() + SD.numpy() * rng.standard_normal(channels.shape)
    ground = {"terrain_height_m": 0.0}
    return Run("a", t.numpy(), measured, command, "g", setup=ground), channels


@pytest.fixture(scope="module")
def model(flown):
    return model_of(flown[0])


def predict(model, run, effect=None, at=None):
    with torch.no_grad():
        return model.predict(run, model.at_prior(), {} if effect is None else {effect: at})


def test_initial_states_are_fitted_away(model, flown):
    """Noisy records give the noise-free flight, but for the initial states' own error."""
    run, truth = flown
    found = predict(model, run)
    assert float((((found - truth) / SD) ** 2).mean().sqrt()) < 0.5
    misfit = (((found - tensor(run.measured)) / SD) ** 2).sum()
    assert float(misfit) / (SAMPLES * 12 - 3 * 12) == pytest.approx(1.0, abs=0.1)
    # another first guess of the same windows ends in the same place
    scene = model.build(model.flights.nominal(), run, Numerics())
    moved = replace(scene.windows, guess=scene.windows.guess + 0.02, start=None)
    other = scene.changed(windows=moved).simulate()
    # but for the pull of the prior
    assert float(((other - scene.simulate()) / SD).abs().max()) < 0.05


def test_flights_of_a_search_for_starts_are_counted_once(model, flown):
    """A new point flies windows from 25 starts or more side by side; a known one flies no more."""
    run, _ = flown
    q, tally = model.at_prior() + 0.03, model.simulations
    steps = []
    for _ in range(2):
        before = tally.work
        with torch.no_grad():
            model.predict(run, q, {})
        steps.append(tally.since(before).steps)
    predicted = round(model.cost(run))
    assert steps[0] >= predicted * 0.25 * 24 and steps[1] == predicted


def test_gaps_do_not_count(model, flown):
    run, _ = flown
    holes = run.measured.copy()
    holes[30:34, :3] = np.nan
    found = predict(model, replace(run, measured=holes))
    assert torch.isfinite(found).all()
    assert float(((found - predict(model, run)) / SD).abs().max()) < 0.5


def test_many_points_are_as_one_by_one(model, flown):
    run, _ = flown
    q = 0.01 * torch.tensor([[0.0, 0.0], [1.0, -1.0], [-0.5, 2.0]], dtype=torch.float64)
    sizes = {
        CAUSES["wind"]: tensor([[0.0, 0.0], [0.01, 0.02], [0.0, -0.01]]),
        CAUSES["rotor_drag"]: tensor([[0.0], [0.001], [0.002]]),
        CAUSES["wake"]: tensor([[0.002], [0.0], [0.001]]),
    }
    many = model.predict_many(run, q, sizes)
    alone = [
        model.predict(run, q[k], {e: s[k] for e, s in sizes.items()}).detach() for k in range(3)
    ]
    torch.testing.assert_close(many[0], alone[0], atol=1e-6, rtol=0)
    for k in (1, 2):
        # a stencil: initial states follow by the tangents of its center, which change with the
        # point; that change times the misfit is left out, as ever in Gauss-Newton
        moved, wrong = (
            ((a - b) / SD).norm() for a, b in ((alone[k], alone[0]), (many[k], alone[k]))
        )
        assert float(wrong) < 0.05 * float(moved)


def test_a_point_that_was_simulated_is_known_again_and_no_other(flown, monkeypatch):
    run, _ = flown
    model, flights = model_of(run), []
    fly = Flyer.__call__
    monkeypatch.setattr(Flyer, "__call__", lambda *a: (flights.append(0), fly(*a))[1])

    def at(change, drag=0.01):
        flights.clear()
        q = torch.full((2,), change, dtype=torch.float64)
        with torch.no_grad():
            return model.predict(run, q, {CAUSES["body_drag"]: size(drag)}), len(flights)

    first = at(0.1)[0]
    again, num_flown = at(0.1 + 1e-16)  # rounded otherwise
    assert num_flown == 0
    assert torch.equal(again, first)
    for other in (at(0.1 + 1e-9), at(0.1, drag=0.01 + 1e-9)):
        assert other[1] > 0
    q = torch.full((2,), 0.1, dtype=torch.float64, requires_grad=True)
    assert model.predict(run, q).requires_grad  # what is differentiated is simulated


@pytest.mark.grad
@pytest.mark.parametrize("effect", [e for e in EFFECTS if e.smooth], ids=lambda e: e.name)
def test_scores(effect, model, flown):
    run, _ = flown

    def at(amount):
        if amount.requires_grad:
            return model.predict(run, model.at_prior(), {effect: amount})
        # about size zero, as in a linearization
        q = model.at_prior().expand(2, -1)
        return model.predict_many(run, q, {effect: torch.stack([0 * amount, amount])})[1]

    # the cubic of a delayed command has a first derivative only: differences of first order
    step = 1e-4 if effect.name == "delay" else 1e-3
    assert score_error(at, effect, tensor(run.measured), SD, step) < 1e-4


def test_base_parameters_and_numerics(flown):
    run, _ = flown
    model = model_of(run, **MOTORS)
    plain = predict(model, run)
    q = torch.zeros(4, dtype=torch.float64, requires_grad=True)
    grads = torch.autograd.grad(((model.predict(run, q) - plain - 1e-3) ** 2).sum(), q)[0]
    assert (grads.abs() > 0).all()
    half = model.predict(run, model.at_prior(), None, Numerics(time_step=0.5))
    assert 0 < float(((half - plain) / SD).abs().max()) < 0.1


def test_a_numerical_cause_blends_flights_beside_others(flown):
    run, _ = flown
    model = model_of(run, **MOTORS, windows={"substeps": 1})
    cause, wind = coarse("time_step", Numerics(time_step=0.25)), CAUSES["wind"]
    q = model.at_prior().expand(3, -1)
    # the kernel is of fourth order: only large multiples of what refining changes can be seen
    sizes = {cause: tensor([[0.0], [4e5], [1e6]]), wind: tensor([[0.01, 0.0]] * 3)}
    many = model.predict_many(run, q, sizes)
    at = {wind: sizes[wind]}
    rough = model.predict_many(run, q, at)[0]
    fine = model.predict_many(run, q, at, cause.refined)[0]
    assert float(((many[2] - many[0]) / SD).abs().max()) > 0.01
    expected = rough + sizes[cause][..., None] * (fine - rough)
    torch.testing.assert_close(many, expected, atol=1e-7, rtol=0)


# Physics, of one window with a known start: straight_up(effect) flies with equal thrusts.


def straight_up(effect, at, thrust=1.2 * HOVER, steps=50, velocity=(0.0, 0.0, 0.0), **start):
    """Channels (steps, 12) of a level flight from the origin after each step, and their times."""
    command = {name: np.full(steps, thrust) for name in NAMES}
    command["voltage_V"] = np.linspace(12.0, 9.0, steps)
    run = Run("b", DT * np.arange(steps), np.zeros((steps, 12)), command, "g")
    scene = model_of(run, **HELD, windows={"length": DT * steps}).build({}, run, Numerics())
    scene = effect.apply(scene, at, run)
    x12 = tensor([[0, 0, 0, 0, 0, 0, *velocity, 0, 0, 0]]).clone()
    for place, value in start.items():
        x12[0, {"yaw": 5, "p": 9, "q": 10, "r": 11}[place]] = value
    # the thrusts of every sample, not of the one before
    thrusts = scene.commands.values
    thrusts = scene.on_their_way(torch.cat([thrusts, thrusts[..., -1:]], -1))
    with torch.no_grad():
        return Flyer(scene, 1).fly_thrusts(x12[None], thrusts[:, None, 1:])[0, 0], run.time_s + DT


def test_wind_with_drag_is_the_closed_form():
    """m v' = F - k T v: exact but for the drag's wind, held over a step."""

    def both(scene, amount, run):
        scene = CAUSES["rotor_drag"].apply(scene, size(0.1), run)
        return CAUSES["wind"].apply(scene, amount, run)

    wind = replace(CAUSES["wind"], apply=both)
    channels, t = straight_up(wind, size(0.5, 0.0), thrust=HOVER)
    rate = 0.1 * GRAVITY  # k T / m
    want = 0.5 / rate * (t - (1 - np.exp(-rate * t)) / rate)
    # the wind of the mid of a step is held over it: (k T / m) a dt^3 / 12 of place in each step
    error = np.abs(channels[:, 0].numpy() - want)
    assert (error <= rate * 0.5 * DT**2 / 12 * t + 1e-9).all()


def test_unknown_wrench_of_constant_knots_is_wind_and_a_torque():
    unknown = unknown_wrench(3, 1.0)
    knots = torch.zeros(6, 3, dtype=torch.float64)
    knots[0], knots[5] = 0.5, 0.1  # north, and yaw in 0.02 N m
    found, t = straight_up(unknown, knots.flatten(), thrust=HOVER)
    want, _ = straight_up(CAUSES["wind"], size(0.5, 0.0), thrust=HOVER)
    torch.testing.assert_close(found[:, :3], want[:, :3], atol=1e-9, rtol=0)
    np.testing.assert_allclose(found[:, 8], 0.1 * 0.02 / 0.02 * t, atol=1e-9)


def test_wind_stays_and_body_tilt_turns():
    pushed, t = straight_up(CAUSES["wind"], size(0.5, 0.0), thrust=HOVER, yaw=np.pi / 2)
    np.testing.assert_allclose(pushed[:, 0], 0.25 * t**2, atol=1e-12)
    leaning, _ = straight_up(CAUSES["body_tilt"], size(0.0, 0.02), thrust=HOVER, yaw=np.pi / 2)
    # pitched by 0.02: thrust leans to the body's -x, which is west with the nose east
    np.testing.assert_allclose(leaning[:, 0], 0.0, atol=1e-9)
    np.testing.assert_allclose(leaning[:, 1], -0.5 * GRAVITY * 0.02 * t**2, rtol=1e-3, atol=1e-9)


def test_inflow_ends_at_a_climb_speed():
    """m v' = T (1 - k v) - m g, v upwards."""
    k, lift = 0.2, 1.2 * GRAVITY
    channels, t = straight_up(CAUSES["inflow"], size(k))
    rate, final = k * lift, (1 - 1 / 1.2) / k
    want = -final * (t - (1 - np.exp(-rate * t)) / rate)
    # loss at the mean speed of a step: an error of second order
    np.testing.assert_allclose(channels[:, 2], want, atol=(rate * DT) ** 2 / 12 * abs(want[-1]))


def test_weak_rotor_center_of_mass_and_curvature_push_as_levers_do():
    arm, thrust = 0.2, HOVER
    weak, _ = straight_up(CAUSES["weak_rotor_1"], size(0.05), thrust=thrust, steps=5)
    # the front right rotor lacks 5 %: roll to the right, nose down, and yaw
    want = 0.05 * thrust * np.array([arm / 0.01, -arm / 0.012, -0.015 * 1.0 / 0.02 * -1.0])
    np.testing.assert_allclose(weak[0, 6:9] / DT, want, rtol=1e-3)
    heavy, _ = straight_up(CAUSES["center_of_mass"], size(0.003, 0.0), thrust=thrust, steps=5)
    np.testing.assert_allclose(heavy[0, 7] / DT, -0.003 * GRAVITY / 0.012, rtol=1e-6)
    curved, _ = straight_up(CAUSES["thrust_curvature"], size(0.1), thrust=HOVER, steps=5)
    np.testing.assert_allclose(curved[:, 11], -GRAVITY, rtol=1e-12)  # in hover it is not there
    loaded, _ = straight_up(CAUSES["thrust_curvature"], size(0.1), thrust=2 * HOVER, steps=5)
    np.testing.assert_allclose(loaded[:, 11], -2 * GRAVITY * (1 + 0.1 * HOVER / 8.0), rtol=1e-12)


def test_voltage_exponent_is_the_power_of_the_voltage():
    channels, t = straight_up(CAUSES["voltage_exponent"], size(2.0), thrust=HOVER)
    voltage = np.linspace(12.0, 9.0, len(t))
    held = GRAVITY * (1.0 - (voltage / 12.0) ** 2)
    velocity = np.cumsum(held * DT)
    place = np.cumsum(velocity * DT - 0.5 * held * DT**2)
    np.testing.assert_allclose(channels[:, 2], place, atol=1e-12)
    # the accelerometer shows thrust alone
    np.testing.assert_allclose(channels[:, 11], -GRAVITY + held, atol=1e-9)


def test_a_sagging_battery_takes_thrust_with_time():
    """Closed form: z'' = g r t, z = g r t^3 / 6, to the first order of held steps."""
    rate = 0.05
    channels, t = straight_up(CAUSES["battery_sag"], size(rate), thrust=HOVER)
    np.testing.assert_allclose(channels[:, 11], -GRAVITY * (1.0 - rate * (t - t[0])), atol=1e-9)
    want = GRAVITY * rate * (t - t[0]) ** 3 / 6.0
    np.testing.assert_allclose(channels[:, 2], want, atol=GRAVITY * rate * t[-1] ** 2 * DT)


def test_an_unrecorded_battery_is_a_cause_where_commands_are_no_speeds():
    for facts, expected in (
        ((), {"battery_sag"}),
        (("battery",), {"voltage_exponent"}),
        (("speeds",), set()),
    ):
        found = {*causes_with(*facts)}
        assert found & {"battery_sag", "voltage_exponent"} == expected


def test_drags_slow_down():
    fast = {"thrust": HOVER, "velocity": (5.0, 0.0, 0.0)}
    parasitic, t = straight_up(CAUSES["parasitic_drag"], size(0.1), **fast)
    # m v' = -c v^2: x = m / c ln(1 + c v_0 t / m), held over a step at its mean speed: dt^2
    np.testing.assert_allclose(parasitic[:, 0], 10.0 * np.log(1 + 0.5 * t), atol=0.25 * DT**2)
    linear, _ = straight_up(CAUSES["body_drag"], size(0.3), **fast)
    np.testing.assert_allclose(linear[:, 0], 5.0 * (1 - np.exp(-0.3 * t)) / 0.3, atol=1e-8)
    rotor, _ = straight_up(CAUSES["rotor_drag"], size(0.05), **fast)
    rate = 0.05 * GRAVITY
    np.testing.assert_allclose(rotor[:, 0], 5.0 * (1 - np.exp(-rate * t)) / rate, atol=1e-8)


def test_wake_takes_thrust_from_the_rear_only_in_fast_flight():
    rest, _ = straight_up(CAUSES["wake"], size(0.1), thrust=HOVER, steps=5)
    np.testing.assert_allclose(rest[:, 6:9], 0.0, atol=1e-9)
    fast, _ = straight_up(CAUSES["wake"], size(0.1), thrust=HOVER, steps=5, velocity=(3.0, 0, 0))
    # at v_h half the loss, times the rear rotors' share a / (a sqrt 2) of the largest arm
    lost = 0.1 * 0.5 / np.sqrt(2) * HOVER
    np.testing.assert_allclose(fast[0, 7] / DT, 2 * lost * 0.2 / 0.012, rtol=0.01)


def test_gyroscopic_torque_is_minus_rates_cross_spin():
    vehicle, amount = quadcopter(), 1e-4
    rates = size(0.3, -0.5, 0.2)
    thrusts = size(2.0, 2.5, 1.0, 1.5)

    class Scene:
        vehicle = Fleet.of([quadcopter()])
        thrust_coefficient = 1e-5

        def with_schedule(self, change):
            return change

    change = CAUSES["gyroscopic"].apply(Scene(), size(amount), None)
    still = torch.zeros(1, 1, 1, 3)
    level = torch.eye(3)[None, None, None]
    motion = FlightMotion(
        Scene.vehicle, still, still, level, rates + still, thrusts, thrusts, still
    )
    more = (change(motion, thrusts[None, None, None]) - thrusts)[0, 0, 0]
    # seen from above (z down), spins +1 turns clockwise: about +z
    spin = amount * np.sum(np.sqrt(thrusts.numpy() / 1e-5) * np.array([1, 1, -1, -1]))
    want = -np.cross(rates.numpy(), [0.0, 0.0, spin])
    np.testing.assert_allclose(vehicle.torque_matrix @ more, want, atol=1e-12)
    assert float(more.sum().abs()) < 1e-12


def test_sensors_by_their_formulas():
    plain, _ = straight_up(CAUSES["sensor_scale"], size(0.0), r=1.0, velocity=(1.0, 0, 0))
    still = {"r": 1.0, "velocity": (1.0, 0.0, 0.0)}
    larger, _ = straight_up(CAUSES["sensor_scale"], size(0.1), **still)
    torch.testing.assert_close(larger[:, :3], 1.1 * plain[:, :3])
    torch.testing.assert_close(larger[:, 3:], plain[:, 3:])
    along, _ = straight_up(CAUSES["ground_scale"], size(0.1), **still)
    torch.testing.assert_close(along[:, :2], 1.1 * plain[:, :2])
    torch.testing.assert_close(along[:, 2:], plain[:, 2:])
    moved, t = straight_up(CAUSES["placement"], size(0.01, 0.0, 0.0), **still)
    np.testing.assert_allclose((moved - plain)[:, 0], 0.01 * np.cos(t), atol=1e-12)
    np.testing.assert_allclose((moved - plain)[:, 1], 0.01 * np.sin(t), atol=1e-12)
    # turned about its x by e, the unit's y sees z times e, its z minus y times e
    tilted, _ = straight_up(CAUSES["sensor_tilt"], size(0.02, 0.0, 0.0), **still)
    np.testing.assert_allclose(tilted[:, 7], plain[:, 7] + 0.02 * plain[:, 8], atol=1e-12)
    np.testing.assert_allclose(tilted[:, 10], plain[:, 10] + 0.02 * plain[:, 11], atol=1e-12)


def test_ground_effect_falls_with_the_square_of_the_height():
    def near(scene, amount, run):
        return CAUSES["ground_effect"].apply(scene.changed(terrain_height=-0.3), amount, run)

    effect = replace(CAUSES["ground_effect"], apply=near)
    channels, _ = straight_up(effect, size(1.0), thrust=HOVER, steps=6)
    gain = 1 + (0.12 / (4 * 0.3)) ** 2
    np.testing.assert_allclose(channels[0, 11], -GRAVITY * gain, rtol=1e-4)


def test_needs_and_errors(flown):
    run, _ = flown
    in_voltage = CAUSES["voltage_exponent"], size(1.0)
    bare = replace(run, command={n: run.command[n] for n in NAMES}, setup={})
    study = Study("s", "copter", CHANNELS, (bare,))
    with pytest.raises(ValueError, match="needs the command voltage_V"):
        predict(model_of(bare), bare, *in_voltage)
    assert CAUSES["lag"].needs(study) is None
    with pytest.raises(ValueError, match="command must be one of"):
        predict(model_of(run, commands=["a", *NAMES[1:]]), run)
    uneven = replace(run, time_s=run.time_s**1.1)
    with pytest.raises(ValueError, match="evenly spaced"):
        predict(model_of(uneven), uneven)
    few = replace(run, measured=run.measured[:, :9])
    with pytest.raises(ValueError, match=r"each of 12 channels, got shape \(110, 9\)"):
        predict(model_of(few), few)


def test_causes_of_rotors_travel_between_processes():
    for effect in EFFECTS[-16:]:
        again = pickle.loads(pickle.dumps(effect))
        assert again.name == effect.name and str(again.apply) == str(effect.apply)


def test_profile_of_a_linear_model_is_ridge_regression():
    rng = np.random.default_rng(0)
    tangent = tensor(rng.standard_normal((20, 16)))
    measured = tensor(rng.standard_normal((1, 20, 1)))

    guess = tensor([[0.0] * 12 + [9.0] * 4])  # thrusts before the record are far from zero

    def predict(start):
        return ((start - guess) @ tangent.T)[..., None]

    windows = Windows(guess, measured, tensor([0.5]))
    shooting = windows.find_starts(predict)
    spread = np.array([0.3] * 3 + [0.2] * 3 + [1.0] * 6 + [2.0] * 4)
    normal = 4 * tangent.T.numpy() @ tangent.numpy() + np.diag(spread**-2)
    best = np.linalg.solve(normal, 4 * tangent.T.numpy() @ measured[0, :, 0].numpy())
    found = shooting.profile(predict)[0, :, 0]
    np.testing.assert_allclose(found, tangent.numpy() @ best, atol=1e-9)


def lagging(starts, delay=0.0):
    """An offset, a thrust before the record, and how the rotor's speed fades from there."""
    place = torch.arange(6, dtype=torch.float64)
    thrust = starts[..., 12:]
    fading = thrust.clamp(min=1e-9).sqrt() * torch.exp(-place[1:])
    return (starts[..., :1] + delay + torch.cat([thrust, fading], -1))[..., None]


def pulled(thrust, past=1.3):
    """Windows of a record that asks for some thrust before it."""
    guess = tensor([[0.0] * 12 + [past]])
    fading = thrust * torch.exp(-torch.arange(6, dtype=torch.float64))
    return Windows(
        guess,
        (0.2 + fading)[None, :, None],
        tensor([0.05]),
        rigid_spread=(1.0,) * 4,
        past_spread=2.0,
    )


def test_a_past_thrust_that_wants_below_zero_is_held_at_zero():
    """The rest of the state is settled beside it, and another search finds the same."""
    windows = pulled(thrust=-3.0)
    found = windows.find_starts(lagging)
    first = found.profile(lagging)
    assert float(found.states[0, 12]) == 0.0
    # the offset is that of least squares with no thrust, prior N(0, 1) included
    offset = float(windows.measured.sum() / 0.05**2 / (6 / 0.05**2 + 1.0))
    assert float(found.states[0, 0]) == pytest.approx(offset, abs=1e-4)
    np.testing.assert_allclose(windows.find_starts(lagging).profile(lagging), first, atol=1e-12)
    for start in (0.3, 4.0):
        other = windows.find_starts(lagging, near=tensor([[5.0] * 12 + [start]]))
        np.testing.assert_allclose(other.profile(lagging), first, atol=1e-9)


def test_a_past_thrust_that_is_let_go_and_comes_back_stays_at_zero():
    """A little of it helps and more does harm: let go and held in turn, it went round in a circle
    of 118 flights."""
    flown = []

    def kinked(starts):
        flown.append(len(starts))
        thrust = starts[..., 12:].clamp(min=0.0)
        fading = (thrust - 2.0 * thrust.clamp(max=0.1)) * torch.exp(-torch.arange(6.0).double())
        return (starts[..., :1] + fading)[..., None]

    found = pulled(thrust=-3.0).find_starts(kinked)
    assert float(found.states[0, 12]) == 0.0
    assert len(flown) < 20


def test_points_too_far_from_the_tangents_have_searches_of_their_own(model, flown, monkeypatch):
    """One of many columns ended a whole answer: its states did not settle by another's tangents."""
    run, _ = flown
    q = torch.stack([model.at_prior(), model.at_prior() + 0.3, model.at_prior() - 0.2])
    want = torch.stack([model.predict(run, point) for point in q])
    profile = FlightShooting.profile

    def strict(self, predict):
        if len(predict(self.states[None])) > 1:
            raise ConvergenceError("too far", residual_norm=1.0, tolerance=0.0, num_iters=1)
        return profile(self, predict)

    monkeypatch.setattr(FlightShooting, "profile", strict)
    found = model.predict_many(run, q)
    # tangents of another point serve where a step is below a hundredth of the spread
    assert float(((found - want) / SD).abs().max()) < 1e-2


def test_a_past_thrust_at_zero_rises_again_when_the_record_asks_for_it():
    below, above = pulled(thrust=-3.0), pulled(thrust=0.8)
    free = above.find_starts(lagging).profile(lagging)
    held = below.find_starts(lagging).states
    assert float(held[0, 12]) == 0.0
    rising = above.find_starts(lagging, near=held)
    np.testing.assert_allclose(rising.profile(lagging), free, atol=1e-6)


def test_steps_that_shrink_slowly_are_made_longer_by_what_they_have_shown():
    """A prediction that bends beside a misfit: Gauss-Newton alone goes half of the way with every
    step, too little for the number of them."""

    def bent(starts):
        first = starts[..., :1]
        return torch.cat([first, 4.0 * first**2], -1)[..., None]

    windows = Windows(tensor([[0.3] * 12]), tensor([[[0.02], [0.12]]]), tensor([0.01]))
    alone, change = [], torch.zeros(1, 12, dtype=torch.float64)
    for _ in range(MAX_STEPS):
        step = windows._find_tangents(bent, change).step
        alone.append(float(step.abs().max()))
        change = change + step
    assert alone[-1] > 3e-5 * SPREAD[0]
    found = float(windows.find_starts(bent).change[0, 0, 0])
    place = np.linspace(-0.3, 0.0, 300_001)
    x = 0.3 + place
    cost = ((x - 0.02) ** 2 + (4 * x**2 - 0.12) ** 2) / 0.01**2 + (place / SPREAD[0]) ** 2
    assert found == pytest.approx(place[cost.argmin()], abs=2e-5)


@pytest.mark.grad
def test_slopes_beside_a_thrust_held_at_zero_are_those_of_the_profile():
    """The profile at a moved model, settled anew, over its step is what backward reports."""
    delay = torch.zeros((), dtype=torch.float64, requires_grad=True)
    shooting = pulled(thrust=-3.0).find_starts(lagging)
    record = shooting.profile(lambda starts: lagging(starts, delay))
    (slope,) = torch.autograd.grad(record.sum(), delay)
    ends = []
    for step in (1e-3, -1e-3):
        moved = partial(lagging, delay=step)
        ends.append(float(pulled(thrust=-3.0).find_starts(moved).profile(moved).sum()))
    assert float(slope) == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=1e-6)


def test_the_vehicle_that_pages_show_flies_where_its_channels_say(model, flown):
    run, truth = flown
    shape = model.shape_of(run, truth)
    hubs = shape.nodes_m.reshape(len(truth), 4, -1, 3)[:, :, 4:].mean(2)  # middles of the discs
    up = torch.diag(tensor([1.0, -1.0, -1.0])).numpy()
    own = hubs @ up - truth[:, None, :3].numpy()
    back = matrix_from_rpy(truth[:, 3:6]).numpy()
    expected = np.broadcast_to(quadcopter().positions.numpy(), own.shape)
    np.testing.assert_allclose(own @ back, expected, atol=1e-12)
    assert model.shape_of(run, truth).triangles.max() < shape.nodes_m.shape[1]
