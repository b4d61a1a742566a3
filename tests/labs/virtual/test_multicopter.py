"""The multicopter laboratory against statics, conservation and our independent flight kernel."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import labs.virtual.multicopter as lab_module
from diffsim.copter.dynamics.flight import fly
from diffsim.copter.dynamics.flight_state import FlightState
from diffsim.copter.vehicle.multicopter import Multicopter
from labs.virtual import CopterLab
from labs.virtual.multicopter import GRAVITY, MANEUVERS, _Flight
from labs.virtual.quaternions import matrix
from tests.labs.truths import exact

pytestmark = pytest.mark.reference
NO_ERRORS = {"camera_to_body_rad": np.zeros(3), "accelerometer_offset_m_s2": np.zeros(3)}
TIME_S = np.arange(200) / 100.0


@pytest.fixture(scope="module")
def lab():
    return CopterLab()


def flight(lab, name="sprint", **effects):
    return _Flight(exact(lab, NO_ERRORS, **effects), MANEUVERS[name])


def hover_rate(lab, velocity=(0, 0, 0), rates=(0, 0, 0), height=5.0, **effects):
    """Acceleration [m/s^2] and angular acceleration [rad/s^2], level, at hover thrust."""
    hovering = np.full(4, 1.4 * GRAVITY / 4)
    x = np.concatenate([[0, 0, -height], [1, 0, 0, 0], velocity, rates, hovering]).astype(float)
    rate = flight(lab, **effects)._rate(x, 0.0, hovering)
    return rate[7:10], rate[10:13]


def test_hover_is_an_equilibrium(lab):
    linear, angular = hover_rate(lab)
    np.testing.assert_allclose([*linear, *angular], 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("effects", "state", "linear", "angular"),
    [
        ({"wind": (0.3, -0.2)}, {}, [0.3 / 1.4, -0.2 / 1.4, 0], [0, 0, 0]),
        ({"body_drag": 0.25}, {"velocity": (2, 1, 3)}, [-0.5 / 1.4, -0.25 / 1.4, 0], [0, 0, 0]),
        (
            {"parasitic_drag": 0.06},
            {"velocity": (3, 0, 4)},
            [-0.9 / 1.4, 0, -1.2 / 1.4],
            [0, 0, 0],
        ),
        # nose up by a turn about y: lift leans back
        ({"body_tilt": (0.0, 0.02)}, {}, [-GRAVITY * 0.02, 0, GRAVITY * 2e-4], [0, 0, 0]),
        # roll to the right: lift leans to the right
        ({"body_tilt": (0.02, 0.0)}, {}, [0, GRAVITY * 0.02, GRAVITY * 2e-4], [0, 0, 0]),
        # mass forward: the nose drops, m g dx / J_y
        (
            {"center_of_mass": (0.005, 0.0)},
            {},
            [0, 0, 0],
            [0, -1.4 * GRAVITY * 0.005 / 0.016, 0],
        ),
        # rotor 0 is front right, its reaction torque up: less of it rolls right, pitches down, yaws
        (
            {"weak_rotor": (0.1, 0, 0, 0)},
            {},
            [0, 0, 0.1 * GRAVITY / 4],
            [
                0.1 * 1.4 * GRAVITY / 4 * 0.2 / 2**0.5 / 0.015,
                -0.1 * 1.4 * GRAVITY / 4 * 0.2 / 2**0.5 / 0.016,
                0.1 * 1.4 * GRAVITY / 4 * 0.0147 / 0.028,
            ],
        ),
        ({"ground_effect": 1.0}, {"height": 0.25}, [0, 0, -GRAVITY * 0.127**2], [0, 0, 0]),
        ({"inflow": 0.03}, {"velocity": (0, 0, -2)}, [0, 0, GRAVITY * 0.06], [0, 0, 0]),
        ({"updraught": 0.8}, {}, [0, 0, -0.8 / 1.4 * np.exp(-0.5 * 1.6**2)], [0, 0, 0]),
    ],
)
def test_what_an_effect_does_at_hover(lab, effects, state, linear, angular):
    got = hover_rate(lab, **state, **effects)
    # the tilts are compared to their second order, 0.02^3 / 6 g = 1e-5
    np.testing.assert_allclose(got[0], linear, atol=2e-5)
    if "body_tilt" not in effects:
        np.testing.assert_allclose(got[1], angular, atol=1e-9)


def test_spin_momentum_does_no_work(lab):
    turning = {"rates": (0.8, -0.5, 0.3)}
    plain, odd = (hover_rate(lab, **turning, gyroscopic=g)[1] for g in (0.0, 4e-5))
    # equal rotors cancel: make them unequal through the thrusts
    np.testing.assert_allclose(plain, odd, atol=1e-12)
    x = np.concatenate([[0, 0, -5], [1, 0, 0, 0], [0] * 3, turning["rates"], [5, 2, 5, 2]])
    torque = [
        (flight(lab, gyroscopic=g)._rate(x.astype(float), 0.0, x[13:])[10:13]) * lab_module.INERTIA
        for g in (0.0, 4e-5)
    ]
    change = torque[1] - torque[0]
    assert np.linalg.norm(change) > 1e-3
    # rotors 0 and 2, whose reaction is upwards, turn about +z and are the faster ones
    spin = 4e-5 * lab_module.SPEED_PER_ROOT * 2 * (np.sqrt(5) - np.sqrt(2))
    np.testing.assert_allclose(change, -np.cross(turning["rates"], [0, 0, spin]), atol=1e-12)
    assert abs(change @ np.array(turning["rates"])) < 1e-12


@pytest.mark.parametrize("name", list(MANEUVERS))
def test_the_recorded_commands_fly_the_same_way_in_the_flight_kernel(lab, name):
    """Open loop for 1.5 s: another integrator, another code, no feedback to hide differences."""
    lab_flight = flight(lab, name)
    rows, commands = lab_flight.run(TIME_S[:151])
    x = torch.from_numpy(lab_flight.start())[None]
    start = FlightState(x[:, 0:3], x[:, 3:7], x[:, 7:10], x[:, 10:13])
    ours = fly(_nominal(), start, torch.from_numpy(commands[None, :150]), dt=0.01, substeps=4)
    place = ours.state.position[0].numpy()
    # commands are clipped by both; Runge-Kutta at 2 and 2.5 ms: micrometers
    np.testing.assert_allclose(place, rows[:, 0:3], atol=2e-5)
    np.testing.assert_allclose(ours.state.body_rates[0].numpy(), rows[:, 6:9], atol=2e-4)


def _nominal() -> Multicopter:
    def f64(value):
        return torch.as_tensor(np.asarray(value), dtype=torch.float64)

    return Multicopter(
        mass=f64(1.4),
        inertia=f64(np.diag(lab_module.INERTIA)),
        positions=f64(lab_module.ROTORS_M),
        directions=f64(np.tile([0.0, 0.0, -1.0], (4, 1))),
        spins=f64(lab_module.SPINS),
        torque_ratios=f64(np.full(4, 0.0147)),
        max_thrusts=f64(np.full(4, 8.0)),
        radii=f64(np.full(4, 0.127)),
    )


def test_the_controller_follows_the_path(lab):
    for name, path in MANEUVERS.items():
        rows, _ = flight(lab, name).run(np.arange(400) / 100.0)
        wanted = np.array([path(t)[0] for t in np.arange(400) / 100.0])
        assert np.abs(rows[:, 0:3] - wanted).max() < 0.5, name


def test_the_accelerometer_is_the_change_of_speed_less_gravity(lab):
    rows, _ = flight(lab).run(TIME_S)
    quats = np.array([_quaternion(r[3:6]) for r in rows])
    between = quats + np.vstack([quats[:1], quats[:-1]])  # each reading is a mean since the last
    rot = np.array([matrix(q) for q in between])
    world = np.einsum("tij,tj->ti", rot, rows[:, 9:12]) + np.array([0.0, 0.0, GRAVITY])
    change = (rows[2:, 0:3] - 2 * rows[1:-1, 0:3] + rows[:-2, 0:3]) / 0.01**2
    mean = 0.5 * (world[1:-1] + world[2:])
    assert np.abs(mean - change)[20:].max() < 0.08  # the sensor's noise


def _quaternion(angles):
    x, y, z, w = Rotation.from_euler("ZYX", angles[::-1]).as_quat()
    return np.array([w, x, y, z])


def test_a_delay_is_a_shift_of_the_command(lab):
    """In open loop: the same thrusts, 15 ms later, whatever the substep."""
    late = flight(lab, delay=0.015)
    rows, commands = late.run(TIME_S[:60])
    step = 1.0 / lab_module.RATE_HZ / lab_module.SUBSTEPS
    x = late.start()
    plain = flight(lab)
    hover = x[13:].copy()
    for i in range(59):
        for k in range(lab_module.SUBSTEPS):
            # mean of the commands over the substep, 15 ms ago; edges fall inside substeps
            fine = (i * 0.01 + (k + (np.arange(10) + 0.5) / 10) * step) - 0.015
            held = [commands[int(t // 0.01)] if t >= 0 else hover for t in fine + 1e-12]
            x = plain._step(x, np.mean(held, axis=0), step, 0.0)
    np.testing.assert_allclose(x[0:3], rows[59, 0:3], atol=1e-9)


def test_finer_steps_change_less_than_a_tenth_of_the_noise(lab, monkeypatch):
    """Feedback and all, so that the commands differ, too."""
    sd = np.array([c.sd for c in lab.channels])
    effects = {"body_drag": 0.25, "lag": 0.03, "ground_effect": 1.0, "gyroscopic": 4e-5}
    coarse, _ = flight(lab, "climb", **effects).run(TIME_S)
    monkeypatch.setattr(lab_module, "SUBSTEPS", 20)
    fine, _ = flight(lab, "climb", **effects).run(TIME_S)
    assert (np.abs(coarse - fine) / sd).max() < 0.1


@pytest.fixture(scope="module")
def null(lab):
    return lab(1)


@pytest.mark.slow
def test_effects_are_off_at_zero(lab, null):
    off = lab.case(1, dict.fromkeys(lab.effects, 0.0)).study
    for a, b in zip(null.runs, off.runs, strict=True):
        np.testing.assert_array_equal(a.measured, b.measured)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(CopterLab.effects))
def test_every_effect_shows(lab, null, name):
    sd = np.array([c.sd for c in lab.channels])
    change = [
        np.sqrt(np.sum(((a.measured - b.measured) / sd) ** 2))
        for a, b in zip(null.runs, lab(1, name).runs, strict=True)
    ]
    assert max(change) > 8.0  # noise units, before any refit


class OnceLab(CopterLab):
    """Each maneuver once."""

    def plans(self, rng):
        return [p for p in super().plans(rng) if not p.name.endswith("_b")]


def test_no_rotor_comes_nearer_to_the_ground_than_its_radius():
    """Below that no form of the ground effect is known."""
    for run in OnceLab().case(108, noise=0.0).study.runs:
        angles, place = run.measured[:, 3:6], run.measured[:, :3]
        body = Rotation.from_euler("ZYX", angles[:, ::-1])
        hubs = [place + body.apply(arm) for arm in lab_module.ROTORS_M]
        assert -np.max(hubs, axis=(0, 1))[2] > lab_module.RADIUS_M, run.name
