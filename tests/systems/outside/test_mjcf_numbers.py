"""Parameters of a MuJoCo model mean what the file with that number means; batches, divergence."""

import os
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data.study import Command
from diffsim.systems.outside.hooks import Place
from diffsim.systems.outside.mjcf import Mjcf
from diffsim.systems.outside.mjcf_runs import DivergedError
from diffsim.systems.outside.mjcf_steps import Steps
from diffsim.systems.outside.model import SimulatorError
from diffsim.systems.outside.setup import outside_setup
from diffsim.systems.outside.source import Call
from tests.systems.outside import scenes

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed (pip install mujoco)")

XML = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="upper.1">
      <joint name="shoulder" axis="0 1 0" damping="0.2" stiffness="0.5"/>
      <inertial mass="1" pos="0.1 0 0" diaginertia="0.010 0.020 0.025"/>
      <body name="lower" pos="0.3 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.1"/>
        <inertial mass="0.5" pos="0.1 0 0" diaginertia="0.010 0.020 0.020"/>
      </body>
    </body>
  </worldbody>
  <actuator>{}</actuator>
  <sensor><jointpos name="a" joint="shoulder"/><jointpos name="b" joint="elbow"/></sensor>
</mujoco>
"""
POSITION = '<position name="m" joint="elbow" kp="3" kv="0.4"/>'
RATIO = '<position name="m" joint="elbow" kp="3" dampratio="0.7"/>'
VELOCITY = '<velocity name="m" joint="elbow" kv="0.6"/>'
MOTOR = '<motor name="m" joint="elbow" forcerange="-2 2"/>'
DAMPER = '<damper name="m" joint="elbow" kv="0.6" ctrlrange="0 9"/>'
GENERAL = '<general name="m" joint="elbow" gainprm="3" biastype="affine" biasprm="0.2 -2 -0.3"/>'
CHANNELS = {"angle_rad": "a", "rate_rad_s": "b"}
#: path, its value, the actuator, and how the file with that number differs
NUMBERS = [
    ("body.upper.1.mass", 1.7, MOTOR, 'mass="1" pos="0.1 0 0" diaginertia="0.010 0.020 0.025"',
     'mass="1.7" pos="0.1 0 0" diaginertia="0.017 0.034 0.0425"'),
    ("body.lower.inertia", 0.06, MOTOR, '0.010 0.020 0.020', '0.03 0.06 0.06'),
    ("body.lower.inertia[1]", 0.015, MOTOR, '0.010 0.020 0.020', '0.010 0.015 0.020'),
    ("body.lower.pos[0]", 0.2, MOTOR, 'pos="0.3 0 0"', 'pos="0.2 0 0"'),
    ("joint.shoulder.damping", 0.9, MOTOR, 'damping="0.2"', 'damping="0.9"'),
    ("joint.elbow.armature", 0.03, MOTOR, 'damping="0.1"', 'damping="0.1" armature="0.03"'),
    ("joint.elbow.frictionloss", 0.3, MOTOR, 'damping="0.1"', 'damping="0.1" frictionloss="0.3"'),
    ("joint.shoulder.stiffness", 2.0, MOTOR, 'stiffness="0.5"', 'stiffness="2"'),
    ("actuator.m.gain", 2.0, MOTOR, '<motor', '<motor gear="2"'),
    ("actuator.m.forcerange", 0.5, MOTOR, "-2 2", "-0.5 0.5"),
    ("actuator.m.forcerange", 0.5, POSITION, "<position", '<position forcerange="-0.5 0.5"'),
    ("actuator.m.weakness", 2.0, POSITION, "<position", '<position forcerange="-0.5 0.5"'),
    ("actuator.m.weakness", 2.0, MOTOR, "-2 2", "-0.5 0.5"),
    ("actuator.m.gain", 9.0, POSITION, 'kp="3"', 'kp="9"'),
    ("actuator.m.kp", 9.0, POSITION, 'kp="3"', 'kp="9"'),
    ("actuator.m.kv", 0.1, POSITION, 'kv="0.4"', 'kv="0.1"'),
    ("actuator.m.kp", 9.0, RATIO, 'kp="3"', 'kp="9"'),
    ("actuator.m.kv", 0.1, RATIO, 'dampratio="0.7"', 'kv="0.1"'),
    ("joint.elbow.armature", 0.1, RATIO, 'damping="0.1"', 'damping="0.1" armature="0.1"'),
    ("body.lower.mass", 1.5, RATIO, '0.5" pos="0.1 0 0" diaginertia="0.010 0.020 0.020"',
     '1.5" pos="0.1 0 0" diaginertia="0.030 0.060 0.060"'),
    ("actuator.m.gain", 1.5, VELOCITY, 'kv="0.6"', 'kv="1.5"'),
    ("actuator.m.kv", 1.5, VELOCITY, 'kv="0.6"', 'kv="1.5"'),
    ("actuator.m.kv", 1.5, DAMPER, 'kv="0.6"', 'kv="1.5"'),
    ("actuator.m.biasprm[1]", -4.0, GENERAL, "0.2 -2 -0.3", "0.2 -4 -0.3"),
    ("actuator.m.gainprm[0]", 4.0, GENERAL, 'gainprm="3"', 'gainprm="4"'),
]  # fmt: skip


def simulate(actuator, parameters=None, was="", now="", held=True):
    text = XML.format(actuator)
    assert was in text
    sim = Mjcf(text.replace(was, now) if was else text, CHANNELS, held=held)
    return sim.predict(parameters or {}, scenes.run_of("steps"))


@pytest.mark.parametrize(("path", "value", "actuator", "was", "now"), NUMBERS)
def test_a_number_is_that_of_the_file(path, value, actuator, was, now):
    plain, stated = simulate(actuator), simulate(actuator, None, was, now)
    assert np.abs(stated - plain).max() > 2e-3, "the number shows"
    # of a model that was compiled with the number: what compilers round, over 500 steps
    np.testing.assert_allclose(simulate(actuator, {path: value}), stated, atol=2e-9)


def test_numbers_are_forgotten_after_each_call_and_do_not_depend_on_their_order():
    sim, run = Mjcf(XML.format(RATIO), CHANNELS), scenes.run_of("sine")
    before = sim.predict({}, run)
    given = {p: v for p, v, actuator, *_ in NUMBERS if actuator is RATIO}
    given |= {"body.lower.inertia[1]": 0.02, "gravity": 3.0}
    one = sim.predict(given, run)
    np.testing.assert_array_equal(sim.predict(dict(reversed(given.items())), run), one)
    np.testing.assert_array_equal(sim.predict({}, run), before)


@pytest.mark.parametrize("held", [True, False])
def test_a_delay_is_a_command_that_comes_late(held):
    run = scenes.run_of("chirp")
    late = 0.06
    command = np.interp(run.time_s - late, run.time_s, run.command["moment_Nm"])
    shifted = replace(run, command={"moment_Nm": command})
    sim = Mjcf(XML.format(MOTOR), CHANNELS, held=held)
    want = sim.predict({}, shifted)
    found = sim.predict({"actuator.m.delay": late}, run)  # three samples, so exact either way
    np.testing.assert_allclose(found, want, atol=1e-9)
    assert np.abs(found - sim.predict({}, run)).max() > 0.05
    # a delay within a step changes the motion, too: the search needs its slope
    near = sim.predict({"actuator.m.delay": late + 1e-4}, run)
    assert 1e-6 < np.abs(near - found).max() < 1e-2


def test_a_delay_of_the_file_is_the_same_delay():
    text = XML.format(MOTOR.replace("<motor", '<motor delay="0.04" nsample="16"'))
    try:
        stated = Mjcf(text, CHANNELS, held=True)
    except ValueError as error:  # before MuJoCo 3.5
        pytest.skip(str(error))
    run = scenes.run_of("steps")
    found = Mjcf(XML.format(MOTOR), CHANNELS, held=True).predict({"actuator.m.delay": 0.04}, run)
    np.testing.assert_allclose(stated.predict({}, run), found, atol=1e-9)
    # one that is set takes the place of the file's
    again = stated.predict({"actuator.m.delay": 0.04}, run)
    np.testing.assert_allclose(again, found, atol=1e-9)


@pytest.mark.parametrize(
    ("path", "value", "actuator", "message"),
    [
        ("actuator.m.gain", 2.0, GENERAL, r"a bias of its own \(gainprm 3 0 0, biasprm 0.2 -2"),
        ("actuator.m.kp", 2.0, MOTOR, "has the form of a motor .* so it has no kp"),
        ("actuator.m.gear", 2.0, MOTOR, "'gear' of a actuator cannot be set.*forcerange, delay"),
        ("actuator.m.forcerange", 2.0, MOTOR.replace("-2 2", "-1 2"), "-1 to 2, which one number"),
        ("actuator.m.delay", -0.1, MOTOR, "must be at least 0, got -0.1"),
        ("body.lower.pos", 0.1, MOTOR, r"name one entry, such as body.lower.pos\[0\]"),
        ("body.lower.mass[1]", 0.1, MOTOR, "mass has no entry 1"),
        ("body.world.mass", 0.1, MOTOR, "the file gives body 'world' no mass"),
        ("joint.elbow.start[1]", 0.1, MOTOR, "joint 'elbow' has 1 numbers; name one"),
        ("joint.elbow.friction", 0.1, MOTOR, "did you mean 'frictionloss'"),
        ("geom.x.size", 0.1, MOTOR, "is none of body.NAME.mass"),
        ("body.lower.mass", float("nan"), MOTOR, "body.lower.mass must lie in"),
    ],
)  # fmt: skip
def test_what_cannot_be_set_is_refused_in_a_sentence(path, value, actuator, message):
    with pytest.raises(ValueError, match=message):
        simulate(actuator, {path: value})


def test_joints_of_several_axes_are_damped_in_all_and_start_by_their_entries():
    text = XML.format("").replace('<joint name="elbow" axis="0 1 0" damping="0.1"/>',
                                  '<joint name="elbow" type="ball"/>')  # fmt: skip
    text = text.replace('<jointpos name="b" joint="elbow"/>', '<ballquat name="b" joint="elbow"/>')
    damped = text.replace('type="ball"', 'type="ball" damping="0.3"')
    run = replace(scenes.run_of("sine"), command={})
    channels = {"angle_rad": "a", "rate_rad_s": "b[3]"}
    start = {"joint.elbow.start_rate[2]": 2.0}
    want = Mjcf(damped, channels).predict(start, run)
    found = Mjcf(text, channels).predict(start | {"joint.elbow.damping": 0.3}, run)
    np.testing.assert_allclose(found, want, atol=1e-9)
    turned = {f"joint.elbow.start[{k}]": x for k, x in enumerate((0.1, -0.7, 0.5, 0.5))}
    read = Mjcf(text, {"angle_rad": "b[1]", "rate_rad_s": "b[3]"}).predict(turned, run)
    np.testing.assert_allclose(read[0], [-0.7, 0.5], atol=1e-12)
    with pytest.raises(ValueError, match=r"has 4 numbers; name one, start\[0\] to \[3\]"):
        Mjcf(text, channels).predict({"joint.elbow.start": 0.1}, run)


UNSTABLE = XML.format(GENERAL.replace("-2 -0.3", "900 3"))


def test_divergence_is_one_sentence_and_leaves_no_file(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    sim, run = Mjcf(UNSTABLE, CHANNELS), scenes.run_of("sine")
    with pytest.raises(DivergedError) as error:
        sim.predict({}, run)
    said = str(error.value)
    assert said.startswith("joint 'elbow' diverged at ") or said.startswith("joint 'shoulder' div")
    assert " s: its acceleration is " in said and "rad/s^2; give the MJCF a shorter" in said
    assert said.count(". ") == 0 and os.listdir(tmp_path) == []
    assert capfd.readouterr() == ("", "")
    # with a force, and at uneven times, steps are taken one by one: the same sentence
    uneven = replace(run, time_s=run.time_s + 1e-4 * (np.arange(len(run.time_s)) % 2))
    with pytest.raises(DivergedError, match=said.split(" at ")[0]):
        sim.predict({}, uneven)
    calm = {"actuator.m.biasprm[1]": -2.0, "actuator.m.biasprm[2]": -0.3}
    calls = [Call(calm, run), Call({}, run)]
    fine, bad = sim.predict_many(calls)
    assert isinstance(bad, DivergedError) and np.isfinite(fine).all()


def test_batches_have_the_bits_of_single_calls_on_any_number_of_threads():
    sim, run = Mjcf(XML.format(POSITION), CHANNELS), scenes.run_of("sine")
    short = replace(run, time_s=run.time_s[:50], measured=run.measured[:50],
                    command={"moment_Nm": run.command["moment_Nm"][:50]})  # fmt: skip
    calls = [Call({"actuator.m.kp": kp}, r) for r in (run, short) for kp in (2.0, 3.0, 9.0)]
    calls.append(Call({}, run, time_step=0.5))
    alone = [sim.predict(c.parameters, c.run, time_step=c.time_step) for c in calls]
    for threads in (1, 2):
        for one, many in zip(alone, sim.predict_many(calls, threads), strict=True):
            np.testing.assert_array_equal(one, many)


def test_mujocos_own_loop_is_the_loop_of_steps():
    """Both read sensors of the state that a step begins with; only forces need the command."""
    text = XML.format(POSITION).replace(
        "</sensor>", '<actuatorfrc name="f" actuator="m"/></sensor>'
    )
    run = scenes.run_of("chirp")
    rolled = Mjcf(text, CHANNELS)
    stepped = Mjcf(text, CHANNELS)
    stepped._make_rollout = None
    np.testing.assert_array_equal(rolled.predict({}, run), stepped.predict({}, run))
    speed = '<jointvel name="v" joint="elbow"/></sensor>'
    channels = {"angle_rad": "b", "rate_rad_s": "v", "moment": "f"}
    angle, rate, force = Mjcf(text.replace("</sensor>", speed), channels).predict({}, run).T
    want = 3.0 * (run.command["moment_Nm"] - angle) - 0.4 * rate
    np.testing.assert_allclose(force, want, atol=1e-9)


def test_models_predict_batches_and_count_their_steps():
    study = scenes.recorded()
    sim = Mjcf(XML.format(POSITION), CHANNELS, {"moment_Nm": "m"})
    setup = outside_setup(study, sim, {})
    run = study.runs[0]
    # 120 samples 20 ms apart by steps of 5 ms, at 2.4 microseconds for two joints
    assert setup.model.cost(run) == pytest.approx(250 + (119 * 4 + 1) * 2.4)
    bad = outside_setup(study, Mjcf(UNSTABLE, CHANNELS, {"moment_Nm": "m"}), {}).model
    with pytest.raises(SimulatorError, match=r"failed in run sine_a at .*DivergedError: joint"):
        bad.predict(run, bad.at_prior())


def test_calls_are_counted_where_they_are_made():
    """A record that is known costs nothing, with forces too; forces in Python cost more."""
    study = scenes.recorded()
    sim = Mjcf(XML.format(POSITION), CHANNELS, {"moment_Nm": "m"})
    setup = outside_setup(study, sim, {}, places=[Place("elbow", "N m", 0.05, speed=3.0)])
    model, run = setup.model.with_shapes_of(setup.effects), study.runs[0]
    (friction,) = [e for e in setup.effects if e.name == "stribeck_friction_at_elbow"]
    (own,) = [e for e in setup.effects if e.name == "dry_friction_at_elbow"]
    (scale,) = [e for e in setup.effects if e.name == "sensor_scale_of_angle"]
    point = torch.stack([model.at_prior()] * 3)
    sizes = {friction: torch.full((3, 1), 0.05), scale: torch.tensor([[0.0], [0.1], [0.2]])}
    sizes = {effect: size.double() for effect, size in sizes.items()}
    model.predict_many(run, point, sizes)
    # of one force: a call of Python and its law, 1 + 1.5 beside the 2.4 of two joints
    assert model.simulations.count == 1
    assert model.simulations.steps == pytest.approx(250 + (119 * 4 + 1) * 4.9, abs=1)
    model.predict_many(run, point, sizes)
    assert model.simulations.count == 1
    model.predict_many(run, point[:1], {own: torch.full((1, 1), 0.05).double()})
    assert model.simulations.steps == pytest.approx(500 + (119 * 4 + 1) * 7.3, abs=1), "MuJoCo's"


def test_steps_are_counted_and_bounded():
    time = np.array([0.0, 0.1, 0.25, 0.3])
    steps = Steps.of(time, 0.04)
    assert steps.samples.tolist() == [0, 3, 7, 9] and not steps.is_even
    np.testing.assert_allclose(steps.starts[steps.samples], time)
    with pytest.raises(ValueError, match="the run takes 30,000,000 steps of 1e-08 s"):
        Steps.of(time, 1e-8)


def test_a_held_command_comes_late_within_a_sample():
    """At samples alone, a step 13 ms late was a ramp of 20 ms."""
    study, fast = scenes.recorded(), XML.replace("0.005", "0.001").format(MOTOR)
    sim = Mjcf(fast, CHANNELS, {"moment_Nm": "m"}, held=True)
    setup = outside_setup(study, sim, {}, held=True)
    (run,) = [r for r in study.runs if r.name == "steps_a"]
    fine = np.linspace(run.time_s[0], run.time_s[-1], 20 * (len(run.time_s) - 1) + 1)
    then = np.searchsorted(run.time_s, fine - 0.013 + 1e-9, side="right") - 1
    told = run.command["moment_Nm"][np.maximum(then, 0)]
    blank = np.zeros((len(fine), len(scenes.CHANNELS)))
    want = sim.predict(
        {}, replace(run, time_s=fine, measured=blank, command={"moment_Nm": told}, columns={})
    )[::20]
    (delay,) = [e for e in setup.effects if e.name == "delay"]
    (scale,) = [e for e in setup.effects if e.name == "command_gain"]
    late = {delay: torch.tensor([0.013], dtype=torch.float64)}
    found = setup.model.predict(run, setup.model.at_prior(), late).numpy()
    np.testing.assert_allclose(found, want, atol=1e-9)
    assert np.abs(found - sim.predict({}, run)).max() > 1e-3
    # before or after a gain, which then is told at samples
    gain = {scale: torch.tensor([0.3], dtype=torch.float64)}
    first, last = (
        setup.model.predict(run, setup.model.at_prior(), both).numpy()
        for both in (late | gain, gain | late)
    )
    np.testing.assert_allclose(first, last, atol=1e-2)
    assert np.abs(last - want).max() > 1e-2
    job = setup.model.scene(run, setup.model.at_prior(), late).job()
    assert job.delays == {"moment_Nm": 0.013}


@pytest.mark.parametrize("stated", [None, 0.5])
def test_a_held_command_comes_late_behind_what_it_was_before_the_run(stated):
    """A drive that had 0.5 N m before, and one that rested: both are heard between samples."""
    fast = XML.replace('"0.005"', '"0.001" gravity="0 0 0"').format(MOTOR)
    study = scenes.recorded()
    if stated is not None:
        study = replace(study, commands=(Command("moment_Nm", before=stated),))
    sim = Mjcf(fast, CHANNELS, {"moment_Nm": "m"}, held=True)
    setup = outside_setup(study, sim, {}, held=True)
    (delay,) = [e for e in setup.effects if e.name == "delay"]
    (scale,) = [e for e in setup.effects if e.name == "command_gain"]
    run = replace(study.runs[0], command={"moment_Nm": study.runs[0].command["moment_Nm"] + 1.0})
    sizes = {scale: 0.3, delay: 0.013}  # heard last
    sizes = {e: torch.tensor([size], dtype=torch.float64) for e, size in sizes.items()}
    job = setup.model.scene(run, setup.model.at_prior(), sizes).job()
    before = 1.3 * (stated or 0.0)
    assert job.delays == {"moment_Nm": 0.013} and job.before == {"moment_Nm": before}
    found = setup.model.predict(run, setup.model.at_prior(), sizes).numpy()
    fine = np.linspace(run.time_s[0], run.time_s[-1], 20 * (len(run.time_s) - 1) + 1)
    then = np.searchsorted(run.time_s, fine - 0.013 + 1e-9, side="right") - 1
    told = np.where(then < 0, before, 1.3 * run.command["moment_Nm"][np.maximum(then, 0)])
    blank = np.zeros((len(fine), len(scenes.CHANNELS)))
    late = replace(run, time_s=fine, measured=blank, command={"moment_Nm": told}, columns={})
    np.testing.assert_allclose(found, sim.predict({}, late)[::20], atol=1e-9)


@pytest.mark.parametrize(("actuator", "gain"), [(POSITION, 0.3), (MOTOR, 1.0)])
def test_the_limit_of_an_actuator_is_a_cause_that_the_file_need_not_state(actuator, gain):
    """A servo that saturates far below its gain times the largest command: no row asked for it; by
    that product sizes over decades ended at 1.2 N m where 0.43 were missing."""
    study = scenes.recorded()
    sim = Mjcf(XML.format(actuator), CHANNELS, {"moment_Nm": "m"})
    setup = outside_setup(study, sim, {})
    (limit,) = [e for e in setup.effects if e.name.startswith("force_limit")]
    reach = max(np.abs(r.command["moment_Nm"]).max() for r in study.fit_runs)
    assert limit.typical == pytest.approx(1.0 / (gain * reach), rel=1e-6)  # below 2 N m
    assert (limit.name, limit.shown_unit, limit.shown_power) == ("force_limit_of_m", "N m", -1)
    run, model = study.runs[0], setup.model
    scene = model.scene(run, model.at_prior(), {limit: model.at_prior().new_tensor([2.5])})
    want = sim.predict({"actuator.m.weakness": 2.5}, run)
    np.testing.assert_array_equal(scene.simulate().numpy(), want)
    assert np.abs(want - sim.predict({}, run)).max() > 1e-3, "the limit shows"


def test_weak_actuators_may_be_all_of_them():
    two = POSITION + '<motor name="s" joint="shoulder"/>'
    study = scenes.recorded()
    study = replace(
        study,
        runs=tuple(
            replace(r, command={**r.command, "other": r.command["moment_Nm"]}) for r in study.runs
        ),
    )
    sim = Mjcf(XML.format(two), CHANNELS, {"moment_Nm": "m", "other": "s"})
    names = [e.name for e in outside_setup(study, sim, {}).effects if "force_limit" in e.name]
    assert names == ["force_limit_of_m", "force_limit_of_s", "force_limit_of_every_actuator"]


def test_limits_of_actuators_are_of_their_own_size_and_one_only_where_they_have_one_unit():
    """By the mean of all a wrist of 3 N m had a usual limit of 60 N m beside a slide of 120 N."""
    slide = '<body><joint name="rail" type="slide"/><geom size="0.1"/></body></worldbody>'
    xml = XML.format(POSITION + '<motor name="s" joint="rail"/>').replace("</worldbody>", slide)
    study = scenes.recorded()
    runs = (
        replace(r, command={**r.command, "other": 100.0 * r.command["moment_Nm"]})
        for r in study.runs
    )
    sim = Mjcf(xml, CHANNELS, {"moment_Nm": "m", "other": "s"})
    setup = outside_setup(replace(study, runs=tuple(runs)), sim, {})
    limits = {e.name: e for e in setup.effects if e.name.startswith("force_limit")}
    assert list(limits) == ["force_limit_of_m", "force_limit_of_s"]
    reach = max(np.abs(r.command["moment_Nm"]).max() for r in study.fit_runs)
    turn, way = limits.values()
    assert (turn.shown_unit, way.shown_unit) == ("N m", "N")
    assert turn.typical == pytest.approx(1.0 / (0.3 * reach), rel=1e-6)
    assert way.typical == pytest.approx(0.01 / reach, rel=1e-6)
