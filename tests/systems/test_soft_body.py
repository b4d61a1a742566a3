"""Soft-body bed: effects have right scores, and act as their physics says."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.core.errors import DiffsimError
from diffsim.data.study import Channel, Run, Study
from diffsim.identify import Numerics
from diffsim.systems.soft_body import unknown_force
from diffsim.systems.soft_body.scene import Moment
from tests.diagnose.gate import score_error, typical
from tests.helpers import numbers as size
from tests.systems.soft_body.bars import held_bar, model_of, pulled_bar, released_bar
from tests.systems.soft_body.causes import ANY_BODY, CAUSES

CELLS = (6, 2, 2)
OF_NO_STUDY = ("stiffness_damping", "added_mass", "current", "support_motion")
"""What no study of ``tests/studies`` has among its causes."""
SMOOTH = [e for e in ANY_BODY if e.smooth and e.kind not in ("actuator", "sensor")]
"""Of the body itself: instruments and commands are those of every kind."""


def make_run(until_s=0.2, dt=0.01, order=2, **command):
    time = np.arange(0.0, until_s + 1e-9, dt)
    values = {name: signal(time) for name, signal in command.items()}
    return Run("a", time, np.zeros((len(time), 3)), values, "g", order=order)


def pulled(time):
    return 0.03 * np.sin(2 * np.pi * 3.0 * time) ** 2


def sway(time):
    return 1e-3 * np.sin(2 * np.pi * 5.0 * time)


RUN = make_run()
PULLED = make_run(0.17, shortening=pulled, support_x_m=sway, support_z_m=lambda t: -0.5 * sway(t))


def beam(**changes):
    return model_of(released_bar(**{"cells": CELLS, "rtol": 1e-11} | changes), RUN)


def tendon(**changes):
    return model_of(pulled_bar(**{"cells": CELLS, "rtol": 1e-11} | changes), PULLED)


def swimmer():
    """Everything at once: tendon, command, water."""
    return tendon(in_water=True)


def predict(model, run, effect=None, at=None, numerics=None):
    sizes = {} if effect is None else {effect: at}
    with torch.no_grad():
        return model.predict(run, model.at_prior(), sizes, numerics)


@pytest.fixture(scope="module")
def plain():
    model = swimmer()
    return model, predict(model, PULLED)


@pytest.fixture(scope="module")
def in_air():
    """Hydrodynamics jumps where faces turn edge-on; nothing else does."""
    model = tendon()
    return model, predict(model, PULLED)


@pytest.mark.parametrize("name", OF_NO_STUDY)
def test_nothing_at_size_zero_and_something_at_typical(name, plain):
    (model, base), effect = plain, CAUSES[name]
    none = predict(model, PULLED, effect, 0 * typical(effect))
    # roundings of a step's solution, rtol 1e-11, on centimeters
    torch.testing.assert_close(none, base, atol=1e-10, rtol=0)
    assert float((predict(model, PULLED, effect, typical(effect)) - base).abs().max()) > 1e-5


@pytest.mark.grad
@pytest.mark.parametrize("effect", SMOOTH, ids=lambda e: e.name + "-" + e.kind)
def test_scores(effect, in_air):
    model, base = in_air
    rng = np.random.default_rng(0)
    measured = base + torch.as_tensor(1e-3 * rng.standard_normal(base.shape))

    def at(amount):
        return model.predict(PULLED, model.at_prior(), {effect: amount})

    assert score_error(at, effect, measured, sd=1e-3) < 1e-4


@pytest.mark.grad
def test_score_of_a_current_that_a_smooth_drag_feels(in_air):
    model, base = in_air
    drag, current = CAUSES["quadratic_drag"], CAUSES["current"]
    rng = np.random.default_rng(0)
    measured = base + torch.as_tensor(1e-3 * rng.standard_normal(base.shape))

    def at(amount):
        return model.predict(PULLED, model.at_prior(), {drag: size(50.0), current: amount})

    # |v| v has a first derivative only: differences are right to first order
    assert score_error(at, current, measured, sd=1e-3, step=1e-4) < 1e-4


def test_needs():
    run = make_run()
    run = replace(run, measured=run.measured[:, :1])
    study = Study("s", "soft_body", (Channel("tip_z_m", "m", "position"),), (run,))
    assert "command" in CAUSES["lag"].needs(study)
    assert "three runs" in CAUSES["temperature_drift"].needs(study)
    assert CAUSES["linear_drag"].needs(study) is None


def swing(model, effect=None, at=None, until_s=1.2, run=None):
    """Frequency [Hz], damping ratio and first amplitude [m] of the tip's free swing."""
    run = make_run(until_s, dt=0.002) if run is None else run
    z = predict(model, run, effect, at)[:, 2].numpy()
    t = np.asarray(run.time_s)
    turn = np.flatnonzero((z[1:-1] - z[:-2]) * (z[2:] - z[1:-1]) < 0) + 1
    swings = np.abs(np.diff(z[turn]))
    period = 2 * np.polyfit(np.arange(len(turn)), t[turn], 1)[0]
    rate = -np.polyfit(np.arange(len(swings)), np.log(swings), 1)[0]  # per half period
    return 1 / period, rate / np.hypot(rate, np.pi), swings[0]


def undamped(modulus=2.6e5, **changes):
    return beam(young=modulus, is_damped=False, dt_s=2e-3, rtol=1e-8, **changes)


def test_stiffness_damping_has_ratio_beta_omega_over_two():
    frequency, none, _ = swing(undamped())
    assert none < 0.002  # what BDF2 adds at this step
    _, ratio, _ = swing(undamped(), CAUSES["stiffness_damping"], size(2e-3))
    # the fit takes turning points at 2 ms, and the second mode decays in the first swings
    assert ratio == pytest.approx(none + 2e-3 * np.pi * frequency, rel=0.05)


def test_loss_factor_is_flat_in_frequency():
    """Twice the frequency (four times E): the same damping ratio, half the loss factor."""
    loss = CAUSES["loss_factor"]
    slow_hz, slow, _ = swing(undamped(), loss, size(0.1), until_s=0.9)
    fast_hz, fast, _ = swing(undamped(4 * 2.6e5), loss, size(0.1), until_s=0.5)
    assert fast_hz / slow_hz == pytest.approx(2.0, rel=0.1)
    assert fast / slow == pytest.approx(1.0, abs=0.12)
    # E in motion is larger than E at rest, of which the size is a share
    assert 0.035 < slow < 0.055


def test_linear_drag_decays_as_work_over_energy():
    """Rate = drag power / kinetic energy with the cantilever's mean square shape of 1/4."""
    drag = 40.0
    frequency, none, _ = swing(undamped())
    _, ratio, _ = swing(undamped(), CAUSES["linear_drag"], size(drag))
    section, around, length = 0.03**2, 4 * 0.03, 0.1
    rate = drag * (around * length / 4 + section) / (2 * 1070 * section * length / 4)
    # stubby bar: shear makes its shape straighter than Bernoulli's
    assert ratio - none == pytest.approx(rate / (2 * np.pi * frequency), rel=0.1)


def test_quadratic_drag_grows_with_amplitude_and_linear_does_not():
    def loss(effect, at, light):
        model = undamped(gravity=9.81 / light)
        return swing(model, effect, at)[1] - swing(model)[1]

    quadratic, linear = CAUSES["quadratic_drag"], CAUSES["linear_drag"]
    ratio = loss(quadratic, size(10.0), 2.0) / loss(quadratic, size(10.0), 1.0)
    # the larger swing also decays faster, which evens them out
    assert ratio == pytest.approx(0.5, abs=0.04)
    ratio = loss(linear, size(40.0), 2.0) / loss(linear, size(40.0), 1.0)
    assert ratio == pytest.approx(1.0, abs=0.05)


def forces(scene, v):
    """Total of a scene's hooks while the body moves at v, (3,) [N]."""
    x = scene.body.x_rest
    moment = Moment(x, v.expand_as(x), 0.0, scene.body.dt)
    return sum(make()(scene, moment).sum(0) for make in scene.makers)


def scene_of(model, run):
    values = {p.name: p.value_at(torch.zeros((), dtype=torch.float64)) for p in model.base}
    return model.build(values, run, Numerics())


def test_drags_and_friction_of_a_body_that_moves_as_a_whole():
    scene, v = scene_of(beam(), RUN), size(0.3, -0.4, 0.0)
    area = 2 * 0.03**2 + 4 * 0.03 * 0.1
    linear = CAUSES["linear_drag"].apply(scene, size(7.0), RUN)
    torch.testing.assert_close(forces(linear, v), -7.0 * area * v)
    quadratic = CAUSES["quadratic_drag"].apply(scene, size(7.0), RUN)
    torch.testing.assert_close(forces(quadratic, v), -7.0 * area * 0.5 * v)
    moving = CAUSES["current"].apply(linear, v, RUN)
    torch.testing.assert_close(forces(moving, v), 0 * v)
    friction = CAUSES["dry_friction"].apply(scene, size(0.02), RUN)
    torch.testing.assert_close(forces(friction, v), size(-0.02, 0.02, 0.0))


@pytest.mark.parametrize("name", ["linear_drag", "quadratic_drag", "dry_friction"])
def test_what_resists_has_the_derivative_of_its_odd_law_at_rest(name):
    """As differences across rest have it: finite, though a speed's root has none there."""
    scene = CAUSES[name].apply(scene_of(beam(), RUN), size(7.0), RUN)
    found = torch.autograd.functional.jacobian(lambda v: forces(scene, v), size(0.0, 0.0, 0.0))
    step = 1e-7 * torch.eye(3).double()
    expected = torch.stack([forces(scene, d) - forces(scene, -d) for d in step], 1) / 2e-7
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)


def test_stiffening_force_is_that_of_its_energy():
    scene = scene_of(beam(), RUN)
    rng = np.random.default_rng(0)
    x = scene.body.x_rest * 1.05 + torch.as_tensor(1e-3 * rng.standard_normal((63, 3)))
    way = torch.as_tensor(rng.standard_normal((63, 3)))
    stiff = CAUSES["stiffening"].apply(scene, size(20.0), RUN)
    force = stiff.makers[0]()(stiff, Moment(x, 0 * x, 0.0, 1e-3))

    def energy(at):
        plain = float(scene.body.elastic_energy(at, physics=scene.body.physics(**scene.parameters)))
        return 20.0 * plain**2 / (2.6e5 * 0.03**2 * 0.1)

    h = 1e-7
    slope = (energy(x + h * way) - energy(x - h * way)) / (2 * h)
    assert float((force * way).sum()) == pytest.approx(-slope, rel=1e-6)


def test_support_that_moves_as_a_whole():
    """Constant acceleration of the support is gravity; what is seen moves with it."""
    model = beam()
    rise = make_run(0.2, support_x_m=lambda t: 0.0 * t, support_z_m=lambda t: 0.25 * t**2)
    found = predict(model, rise, CAUSES["support_motion"], size(1.0, 0.0))
    heavy = predict(model, rise, CAUSES["weight"], size(0.5))
    heavy[:, 2] += torch.as_tensor(0.25 * rise.time_s**2)
    torch.testing.assert_close(found, heavy, atol=1e-8, rtol=0)


def test_added_mass_only_slows_time_down():
    """As much again as the bar's own mass: the same motion, sqrt(2) times slower."""
    plain = undamped()
    wide = replace(RUN, time_s=RUN.time_s * np.sqrt(2.0))
    slow = predict(plain, wide, CAUSES["added_mass"], size(1.07), Numerics(time_step=np.sqrt(2.0)))
    torch.testing.assert_close(slow, predict(plain, RUN), atol=1e-8, rtol=0)


def test_weight_tilt_and_drift_are_what_other_settings_give():
    model = beam()
    heavy = predict(model, RUN, CAUSES["weight"], size(0.5))
    torch.testing.assert_close(heavy, predict(beam(gravity=10.31), RUN), atol=1e-9, rtol=0)
    leaning = predict(model, RUN, CAUSES["tilt"], size(0.0, 0.5))
    assert float(leaning[-1, 1].abs()) > 1e-4 and float(predict(model, RUN)[-1, 1].abs()) < 1e-9
    drifted = predict(model, RUN, CAUSES["temperature_drift"], size(0.05))
    stiffer = beam(young=1.1 * 2.6e5)
    torch.testing.assert_close(drifted, predict(stiffer, RUN), atol=1e-9, rtol=0)
    lost = predict(model, RUN, CAUSES["stiffness_loss"], size(-0.1, -0.1, -0.1))
    torch.testing.assert_close(lost, drifted, atol=1e-9, rtol=0)


@pytest.mark.parametrize(
    ("effect", "at"),
    [
        (CAUSES["temperature_drift"], size(-0.6)),  # RUN is third of its series
        (CAUSES["stiffness_loss"], size(0.0, 0.0, 1.2)),
        # the centers of these cells keep some stiffness, those of finer ones would not
        (CAUSES["stiffness_loss"], size(1.01, 0.0, 0.0)),
    ],
)
def test_size_that_leaves_no_stiffness_is_a_step_too_far_for_a_search(effect, at):
    with pytest.raises(DiffsimError, match="no stiffness"):
        predict(beam(), RUN, effect, at)


def test_current_bends_the_bar_downstream(plain):
    model, base = plain
    flowing = predict(model, PULLED, CAUSES["current"], size(0.0, 0.1, 0.0))
    assert float((flowing - base)[:, 1].mean()) > 1e-5


def test_delay_of_command_and_late_clock_are_the_same():
    model = tendon(rtol=1e-8)
    late = predict(model, PULLED, CAUSES["sensor_delay"], size(0.03))
    slow = predict(model, PULLED, CAUSES["delay"], size(0.03))
    # the command is straight between samples of 10 ms, steps are 4 ms: both see it at other places
    assert float((late - slow).abs().max()) < 0.01 * float(late.abs().max())
    early = predict(model, PULLED)
    torch.testing.assert_close(late[3:], early[:-3], atol=1e-12, rtol=0)


def test_sensors_by_their_formulas(plain):
    model, y = plain

    def seen(effect, at):
        return predict(model, PULLED, effect, at)

    torch.testing.assert_close(seen(CAUSES["sensor_scale"], size(0.1)), 1.1 * y)
    torch.testing.assert_close(seen(CAUSES["placement"], size(1.0, 2.0, 3.0)), y + size(1, 2, 3))
    tilted = seen(CAUSES["sensor_tilt"], size(0.0, 0.01, 0.0))  # x gains z, z loses x
    torch.testing.assert_close(tilted[:, 0], y[:, 0] + 0.01 * y[:, 2])
    radius = y.norm(dim=1, keepdim=True)
    torch.testing.assert_close(seen(CAUSES["lens"], size(20.0)), y * (1 + 20 * radius**2))
    free = beam()  # without a command, whose samples have the record's times
    fast = replace(RUN, time_s=1.01 * RUN.time_s)
    rate = predict(free, RUN, CAUSES["clock_rate"], size(0.01))
    torch.testing.assert_close(rate, predict(free, fast), atol=1e-12, rtol=0)


def test_numerics_change_step_mesh_and_tolerance():
    scene = scene_of(beam(), RUN)
    values = {"youngs_modulus": size(2.6e5)[0], "rayleigh_beta": size(2e-3)[0]}
    finer = beam().build(values, RUN, Numerics(time_step=0.5, mesh=0.5, tolerance=0.1))
    assert finer.body.dt == pytest.approx(0.5 * scene.body.dt)
    assert finer.body.mesh.num_elements == 8 * scene.body.mesh.num_elements
    assert finer.body.solver.rtol == pytest.approx(1e-12)


def test_unknown_force_of_even_knots_is_weight():
    """Force per volume rho dg, the same at all times: as if gravity were dg larger."""
    model, unknown = beam(), unknown_force(3, 0.2)
    knots = torch.zeros(3, 2, 3, dtype=torch.float64)
    knots[2, 0] = -1070.0 * 0.5
    found = predict(model, RUN, unknown, knots.flatten())
    want = predict(model, RUN, CAUSES["weight"], size(0.5))
    torch.testing.assert_close(found, want, atol=1e-9, rtol=0)


def held_run(load_kg=0.0, until_s=0.2):
    """Held until 0, with channels of the mean marker in the plane of the bar."""
    time = np.arange(-0.02, until_s, 0.01)
    load = {"load_kg": load_kg}
    return Run("a", time, np.zeros((len(time), 3)), {}, "g", setup=load)


def held_beam():
    return model_of(held_bar(), held_run())


def test_slack_string_lets_the_bar_go_alone_first():
    model, slack = held_beam(), CAUSES["slack_string"]
    loaded, light = held_run(0.05), held_run(0.0)
    alone, late = predict(model, light), predict(model, loaded, slack, size(0.5 * 9.81 * 0.05**2))
    before = loaded.time_s < 0.045
    torch.testing.assert_close(late[before], alone[before], atol=1e-8, rtol=0)
    assert float((late - alone)[~before].abs().max()) > 1e-3
    fixed = predict(model, loaded)
    soon = predict(model, loaded, slack, size(1e-9))
    # the speed at a catch in the first step is known to what the step resolves
    assert float((soon - fixed).abs().max()) < 5e-3 * float(fixed.abs().max())
    torch.testing.assert_close(predict(model, light, slack, size(0.01)), alone)


def test_catch_of_the_string_keeps_momentum():
    model, run = held_beam(), held_run(0.05)
    fixed, fall = model.scene(run, model.at_prior()), size(0.5 * 9.81 * 0.03**2)
    scene = CAUSES["slack_string"].apply(fixed, fall, run)
    load = scene.number("attached_mass")
    own = scene.number("density") * scene.body.nodal_volume
    falling = scene.falling(scene.last_fall_step())
    fall = falling.motion(falling.num_steps())
    x, v = scene._interpolate_catch(fall, scene.last_fall_step())
    caught = scene.swinging(fall, scene.last_fall_step())
    after = caught.start_velocity
    down = scene.number("gravity") / 9.81
    before = (own[:, None] * v).sum(0) @ down + load.sum() * 9.81 * 0.03
    torch.testing.assert_close(caught.start_position, x)
    torch.testing.assert_close(((own + load)[:, None] * after).sum(0) @ down, before)
    across = after - (after @ down)[:, None] * down
    torch.testing.assert_close(across, v - (v @ down)[:, None] * down)


def test_creep_takes_the_stiffness_of_motion_away_in_time():
    scene = scene_of(beam(), RUN)
    crept = CAUSES["creep"].apply(scene, size(0.04), RUN)
    hook = crept.makers[0]()
    rest = scene.body.x_rest
    bent = rest + torch.stack([0 * rest[:, 0], 0 * rest[:, 0], 0.05 * rest[:, 0]], 1)
    hook(crept, Moment(rest, 0 * rest, 0.0, 1e-6))
    soon = hook(crept, Moment(bent, 0 * rest, 0.0, 1e-6))
    force, _ = scene.solid_force()(bent)
    assert float(soon.norm()) < 1e-5 * float(force.norm())
    for _ in range(2):
        late = hook(crept, Moment(bent, 0 * rest, 0.0, 1e5))
    # what the higher modulus of fast motion adds is gone
    torch.testing.assert_close(late, -3 * 0.04 * force, atol=1e-3 * float(force.norm()), rtol=0)
