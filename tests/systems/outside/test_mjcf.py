"""MuJoCo models as simulators, where MuJoCo is installed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Run, Study
from diffsim.identify.model import Parameter
from diffsim.systems.outside.forces import PlaceForces, Term
from tests.systems.outside import scenes
from tests.systems.outside.pendulum_sim import Pendulum

pytest.importorskip("mujoco", reason="MuJoCo is not installed (pip install mujoco)")

from diffsim.systems.outside.mjcf import Mjcf
from diffsim.systems.outside.model import SimulatorError
from diffsim.systems.outside.setup import outside_setup
from diffsim.systems.outside.source import MJCF
from diffsim.systems.registry import description_of

MASS, LENGTH = 0.4, 0.5
XML = """
<mujoco>
  <option timestep="0.005" integrator="RK4"/>
  <worldbody>
    <body name="rod">
      <inertial mass="0.4" pos="0 0 -0.5" diaginertia="0.02 0.02 0.001"/>
      <joint name="hinge" axis="0 -1 0" damping="0.06"/>
      <site name="tip" pos="0 0 -0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
  <sensor>
    <jointvel name="rate" joint="hinge"/>
    <framepos name="tip" objtype="site" objname="tip"/>
    <jointpos name="angle" joint="hinge"/>
  </sensor>
</mujoco>
"""
CHANNELS = {"angle_rad": "angle", "rate_rad_s": "rate"}
OWN = {
    "inertia": 0.02 + MASS * LENGTH**2,
    "damping": 0.06,
    "gravity_moment": MASS * LENGTH * 9.81,
}


def test_a_pendulum_equals_the_closed_equation():
    run, sim = scenes.run_of("chirp"), Mjcf(XML, CHANNELS)
    want = Pendulum(8).predict(OWN, run)
    coarse = np.abs(sim.predict({}, run) - want).max()
    fine = np.abs(sim.predict({}, run, time_step=0.5) - want).max()
    # commands are held over each of MuJoCo's steps, at their middle: second order
    assert coarse < 5e-4 and fine < 0.3 * coarse


def test_parameters_act_as_in_the_closed_equation_and_are_forgotten():
    run, sim = scenes.run_of("sine"), Mjcf(XML, CHANNELS)
    before = sim.predict({}, run)
    given = {"body.rod.mass": 0.6, "joint.hinge.damping": 0.1, "gravity": 5.0}
    want = {"inertia": 1.5 * OWN["inertia"], "damping": 0.1, "gravity_moment": 0.6 * LENGTH * 5.0}
    np.testing.assert_allclose(sim.predict(given, run), Pendulum(8).predict(want, run), atol=2e-4)
    np.testing.assert_array_equal(sim.predict({}, run), before)


LAWS = [("viscous_friction", 0.1), ("square_drag", 0.05), ("added_spring", 0.5)]


@pytest.mark.parametrize(("law", "size"), LAWS)
def test_forces_at_a_joint_act_as_in_the_closed_equation(law, size):
    run, forces = (
        scenes.run_of("sine"),
        PlaceForces(["hinge"], [Term("hinge", scenes.law_of(law), size)]),
    )
    want = Pendulum(8).predict(OWN, run, forces)
    # asked for at every stage of the integrator: the error is that of the commands
    got = Mjcf(XML, CHANNELS).predict({}, run, forces, time_step=0.5)
    np.testing.assert_allclose(got, want, atol=1e-4)
    assert np.abs(Mjcf(XML, CHANNELS).predict({}, run) - want).max() > 0.05


def test_a_start_and_an_entry_of_a_vector():
    run = replace(scenes.run_of("sine"), command={"moment_Nm": np.zeros(len(scenes.TIME))})
    sim = Mjcf(XML, {"angle_rad": "angle", "x_m": "tip[0]"})
    out = sim.predict({"joint.hinge.start": 0.3, "joint.hinge.start_rate": 0.5}, run)
    assert out[0, 0] == pytest.approx(0.3)
    assert (out[1, 0] - out[0, 0]) / 0.02 == pytest.approx(0.5, abs=0.2)
    np.testing.assert_allclose(np.abs(out[:, 1]), LENGTH * np.abs(np.sin(out[:, 0])), atol=1e-9)


def test_commands_go_to_actuators_by_name():
    run, sim = scenes.run_of("sine"), Mjcf(XML, CHANNELS, {"moment_Nm": "motor"})
    np.testing.assert_array_equal(sim.predict({}, run), Mjcf(XML, CHANNELS).predict({}, run))
    assert not np.array_equal(sim.predict({}, run), Mjcf(XML, CHANNELS, held=True).predict({}, run))


@pytest.mark.parametrize(
    ("settings", "parameters", "message"),
    [
        ({"channels": {"angle_rad": "angel"}}, {}, "no sensor 'angel'; did you mean 'angle'"),
        ({"commands": {"moment_Nm": "moter"}}, {}, "no actuator 'moter'; did you mean 'motor'"),
        ({}, {}, "5 sensor values for 2 channels"),
        ({"channels": CHANNELS}, {"body.rood.mass": 1.0}, "no body 'rood'; did you mean 'rod'"),
        ({"channels": CHANNELS}, {"joint.hinge.dampng": 1.0}, "did you mean 'damping'"),
        ({"channels": CHANNELS}, {"rod.mass": 1.0}, "is none of body.NAME.mass"),
    ],
)
def test_names_that_the_mjcf_lacks_are_said(settings, parameters, message):
    with pytest.raises(ValueError, match=message):
        Mjcf(XML, **settings).predict(parameters, scenes.run_of("sine"))


def test_a_model_in_several_files_is_one_simulator(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "sensors.xml").write_text(f"<mujoco>{XML.partition('</actuator>')[2]}")
    whole = XML.partition("<sensor>")[0] + '<include file="parts/sensors.xml"/></mujoco>'
    (tmp_path / "rod.xml").write_text(whole)
    run = scenes.run_of("sine")
    found = Mjcf(str(tmp_path / "rod.xml"), CHANNELS).predict({}, run)
    np.testing.assert_array_equal(found, Mjcf(XML, CHANNELS).predict({}, run))
    with pytest.raises(ValueError, match=r"<include> names 'parts/sensors.xml'; give the model as"):
        Mjcf(whole)


def test_strengths_of_all_drives_are_known_where_each_is_a_parameter():
    """And they have a twin: every mass, inertia and loss the other way round moves alike."""
    pair = XML.replace("</actuator>", '<motor name="second" joint="hinge" gear="0.1"/></actuator>')
    study, sim = scenes.recorded(), Mjcf(pair, CHANNELS, {"moment_Nm": "motor"})
    gains = [Parameter(f"actuator.{n}.gain", 1.0, 0.1) for n in ("motor", "second")]
    known = outside_setup(study, sim, gains).model
    assert known.drives == ("actuator.motor.gain", "actuator.second.gain")
    assert outside_setup(study, sim, gains[:1]).model.drives == ()
    run, plain = scenes.run_of("sine"), {"body.rod.mass": 0.5, "joint.hinge.damping": 0.05}
    strong = sim.predict({**plain, **{p.name: 4.0 for p in gains}}, run)
    light = sim.predict({n: 0.25 * v for n, v in plain.items()}, run)
    np.testing.assert_allclose(strong, light, atol=1e-9)


@pytest.mark.parametrize("joint", ['<freejoint name="root"/>', '<joint name="root" type="ball"/>'])
def test_a_joint_of_several_axes_is_no_place_of_a_force(tmp_path, joint):
    """A force pushed it along its first axis alone."""
    text = f"""<mujoco><worldbody><body name="a">{joint}<geom size="0.1"/>
      <body name="b"><joint name="hinge"/><geom size="0.1"/></body></body></worldbody></mujoco>"""
    channels = {"c": "joint.hinge.position"}
    simulator = Mjcf(text, channels)
    law = scenes.law_of("viscous_friction")
    force = PlaceForces(["root"], [Term("root", law, 0.1)])
    run = Run("r", 0.01 * np.arange(9.0), np.zeros((9, 1)), {}, "r")
    with pytest.raises(ValueError, match=r"joint 'root' has [36] axes, and a force acts about one"):
        simulator.predict({}, run, force)
    (tmp_path / "a.xml").write_text(text)
    keys = {"force": {"root": {"unit": "N", "typical": 1.0, "speed": 1.0}}}
    model = {"system": "outside", "simulator": MJCF, "options": {"model": "a.xml"}, "hooks": keys}
    study = Study(
        name="s",
        system="outside",
        channels=(Channel("c", "rad", "angle"),),
        runs=(run,),
        model=model,
        folder=tmp_path,
    )
    said = [str(p) for p in description_of(study).problems(study)]
    assert any("joint 'root' has" in one for one in said)


def test_pairs_are_looked_for_only_where_shapes_may_touch():
    """What MuJoCo asks at each step costs a leg a sixth of it."""
    import mujoco

    shape = '<geom size="0.1" contype="{}" conaffinity="{}"/><site'
    off, run = int(mujoco.mjtDisableBit.mjDSBL_CONTACT), scenes.run_of("sine")
    floor = '<worldbody><geom type="plane" size="1 1 1" pos="0 0 -2"/>'
    none = Mjcf(XML, CHANNELS).predict({}, run)
    for masks, is_off in (((0, 0), True), ((1, 0), False), ((0, 1), False), ((2, 0), True)):
        xml = XML.replace("<site", shape.format(*masks)).replace("<worldbody>", floor)
        sim = Mjcf(xml, CHANNELS)
        assert bool(sim.plain.opt.disableflags & off) == is_off
        np.testing.assert_array_equal(sim.predict({}, run), none)


def test_records_that_slopes_and_scans_ask_for_again_are_known():
    """Of 64 that were kept the first were simulated again."""
    study, sim = scenes.recorded(), Mjcf(XML, CHANNELS, {"moment_Nm": "motor"})
    model = outside_setup(study, sim, [Parameter("joint.hinge.damping", 0.06, 0.01)]).model
    points = model.at_prior().repeat(100, 1)
    (place,) = [i for i, p in enumerate(model.base) if p.name == "joint.hinge.damping"]
    points[:, place] = torch.linspace(-1.0, 1.0, 100)
    run = study.runs[0].part(slice(20))
    first = model.predict_many(run, points)
    assert model.simulations.count == 100
    again = model.predict_many(run, points)
    assert model.simulations.count == 100 and torch.equal(again, first)
    other = replace(run, command={"moment_Nm": run.command["moment_Nm"] + 1e-9})
    model.predict_many(other, points[:1])
    assert model.simulations.count == 101
    # of a batch in which one fails the others are known
    bad = points[:3] + 0.001
    bad[1, place] = -1e6
    with pytest.raises(SimulatorError, match="must be at least 0"):
        model.predict_many(run, bad)
    counted = model.simulations.count
    model.predict_many(run, bad[[0, 2]])
    assert model.simulations.count == counted
