"""Own multicopters from a short YAML, MJCF or URDF: closed forms and MuJoCo's own accelerations."""

import numpy as np
import pytest
import torch

from diffsim.copter import hover, load_vehicle
from diffsim.copter.exchange.vehicle_file import vehicle_from_text
from diffsim.copter.simulator import FlightSimulator
from diffsim.copter.simulator.mission import load_mission

QUAD = """
body: FLU
mass: 1.2 kg
inertia: [0.011, 0.012, 0.02]
rotors:
  - {at: [0.15, -0.15, 0.02], spin: ccw}
  - {at: [-0.15, 0.15, 0.02], spin: ccw}
  - {at: [0.15, 0.15, 0.02], spin: cw}
  - {at: [-0.15, -0.15, 0.02], spin: cw}
rotor: {radius: 5 inch, max_thrust: 8 N, torque_ratio: 15 mm}
battery: {cells: 4, capacity: 3000}
"""

MJCF = """
<mujoco model="own_x">
  <worldbody>
    <body name="x" pos="0 0 1">
      <freejoint/>
      <inertial pos="0.01 0 0.02" mass="1" diaginertia="0.01 0.012 0.02"/>
      <body name="camera" pos="0.1 0 0" euler="0 30 0">
        <inertial pos="0 0 0" mass="0.2" diaginertia="1e-4 2e-4 3e-4"/>
      </body>
      <site name="s1" pos="-0.14 -0.18 0.05"/> <site name="s2" pos="-0.14 0.18 0.05"/>
      <site name="s3" pos="0.14 0.18 0.08"/>
      <site name="s4" pos="0.14 -0.18 0.08" euler="5 0 0"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="t1" site="s1" gear="0 0 1 0 0 -0.02" ctrlrange="0 6"/>
    <motor name="t2" site="s2" gear="0 0 1 0 0 0.02" ctrlrange="0 6"/>
    <motor name="t3" site="s3" gear="0 0 1 0 0 -0.02" ctrlrange="0 6"/>
    <motor name="t4" site="s4" gear="0 0 2 0 0 0.04" ctrlrange="0 3"/>
  </actuator>
</mujoco>
"""

URDF = """
<robot name="own_quad">
  <link name="base"><inertial><origin xyz="0 0 0.01"/><mass value="1"/>
    <inertia ixx="0.01" iyy="0.012" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://nowhere/base.dae"/></geometry></visual></link>
  {links}
</robot>
"""


def urdf_text():
    place = [(0.1, -0.1), (-0.1, 0.1), (0.1, 0.1), (-0.1, -0.1)]
    links = "".join(
        f'<link name="rotor_{k}"><inertial><mass value="0.05"/><inertia ixx="1e-6" iyy="1e-6" '
        'izz="2e-6" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        f'<joint name="joint_{k}" type="continuous"><parent link="base"/><child link="rotor_{k}"/>'
        f'<origin xyz="{x} {y} 0.02"/><axis xyz="0 0 1"/></joint>'
        for k, (x, y) in enumerate(place)
    )
    return URDF.format(links=links)


def test_a_few_numbers_hover():
    made = vehicle_from_text(QUAD)
    thrusts = hover(made.vehicle).thrusts
    assert torch.allclose(thrusts, torch.full((4,), 1.2 * 9.81 / 4, dtype=torch.float64))
    assert float(made.vehicle.radii[0]) == pytest.approx(0.127)
    assert float(made.battery.nominal_voltage) == pytest.approx(4 * 3.7)


def test_both_frames_say_the_same():
    turned = QUAD.replace("FLU", "FRD").replace("0.02],", "-0.02],")
    turned = turned.replace("[0.15, -0.15", "[0.15, 9").replace("[0.15, 0.15", "[0.15, -0.15")
    turned = turned.replace("[0.15, 9", "[0.15, 0.15")
    turned = turned.replace("[-0.15, 0.15", "[-0.15, 9").replace("[-0.15, -0.15", "[-0.15, 0.15")
    turned = turned.replace("[-0.15, 9", "[-0.15, -0.15")
    a, b = vehicle_from_text(QUAD).vehicle, vehicle_from_text(turned).vehicle
    for name in ("positions", "directions", "spins", "inertia"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name


def test_the_layers_give_gradients_through_it():
    vehicle = vehicle_from_text(QUAD).vehicle
    mass = vehicle.mass.clone().requires_grad_(True)
    hover(vehicle.replace(mass=mass)).thrusts.sum().backward()
    assert float(mass.grad) == pytest.approx(9.81)


def test_it_flies_in_closed_loop_and_says_what_was_assumed():
    made = vehicle_from_text(QUAD, name="mine")
    assert made.assumed == (
        "current_coefficient",
        "speed_exponent",
        "thrust_coefficient",
        "time_constant",
    )
    flight = FlightSimulator(made).run(load_mission("hover"), seconds=6.0)
    summary = flight.summary()
    assert summary["outcome"] == "done"
    assert summary["rms_position_error_m"] < 0.1


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("mass: 1.2 kg", "", "without body_file, mass must be given"),
        ("mass: 1.2 kg", "mass: -1", "mass: must be above 0"),
        ("mass: 1.2 kg", "mass: 1.2 m", "mass: "),
        ("inertia: [0.011, 0.012, 0.02]", "inertia: [1, 2]", "needs 3 numbers"),
        ("inertia: [0.011, 0.012, 0.02]", "inertia: [1, 2, -3]", "izz. must be above 0"),
        ("spin: ccw", "spin: left", r"rotors\[0\].spin: must be 'cw' or 'ccw'"),
        ("max_thrust: 8 N, ", "", "without model, max_thrust must be given"),
        ("radius: 5 inch", "model: kde2814_10in, radius: 5 inch", "model gives radius"),
        ("at: [0.15, -0.15, 0.02]", "body: rotor_0", "needs body_file"),
        ("battery: {cells: 4", "battery: {sells: 4", "no key 'sells' here.*cells"),
    ],
)
def test_mistakes_name_the_key(old, new, words):
    with pytest.raises(ValueError, match=words):
        vehicle_from_text(QUAD.replace(old, new, 1), "my_quad.yaml")


def test_mjcf_accelerates_as_in_mujoco(tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="pip install mujoco")
    path = tmp_path / "x.xml"
    path.write_text(MJCF)
    made = load_vehicle(path)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.ctrl[:] = controls = np.array([2.0, 3.5, 1.0, 2.2])
    mujoco.mj_forward(model, data)
    # MuJoCo's free joint: acceleration of the body's origin in the world, turning in the body
    thrusts = torch.tensor(controls * [1, 1, 1, 2])
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    rates = accelerations(made.vehicle, thrusts)
    center = torch.as_tensor(made.center_of_mass)
    turning = rates[1]
    at_origin = rates[0] - torch.linalg.cross(turning, center)
    assert np.allclose((flip @ at_origin).numpy(), data.qacc[:3], rtol=0, atol=1e-9)
    assert np.allclose((flip @ turning).numpy(), data.qacc[3:6], rtol=0, atol=1e-9)
    assert made.vehicle.max_thrusts.tolist() == [6.0] * 4
    assert "radius" in made.assumed


def accelerations(vehicle, thrusts):
    """Of the center of mass and about it, at rest and level, forward, right, down."""
    force = vehicle.force_matrix @ thrusts / vehicle.mass
    gravity = torch.tensor([0.0, 0.0, 9.81], dtype=torch.float64)
    return force + gravity, torch.linalg.solve(vehicle.inertia, vehicle.torque_matrix @ thrusts)


def test_urdf_gives_mass_and_places_by_name(tmp_path):
    pytest.importorskip("mujoco", reason="pip install mujoco")
    (tmp_path / "quad.urdf").write_text(urdf_text())
    spins = ["ccw", "ccw", "cw", "cw"]
    rotors = "".join(f"  - {{body: rotor_{k}, spin: {s}}}\n" for k, s in enumerate(spins))
    text = f"body: FLU\nbody_file: quad.urdf\nrotors:\n{rotors}rotor: {{model: kde2814_10in}}\n"
    (tmp_path / "quad.yaml").write_text(text)
    vehicle = load_vehicle(tmp_path / "quad.yaml").vehicle
    assert float(vehicle.mass) == pytest.approx(1.2)
    height = (1.0 * 0.01 + 0.2 * 0.02) / 1.2
    assert vehicle.positions[0].tolist() == pytest.approx([0.1, 0.1, -(0.02 - height)])
    # parallel axes by hand, about the common center of mass
    xx = 0.01 + 1.0 * (0.01 - height) ** 2 + 4 * (1e-6 + 0.05 * (0.1**2 + (0.02 - height) ** 2))
    assert float(vehicle.inertia[0, 0]) == pytest.approx(xx, rel=1e-6)
    with pytest.raises(ValueError, match=r"no link, body or site 'prop'; it has base, .*rotor_0"):
        (tmp_path / "quad.yaml").write_text(text.replace("rotor_0", "prop"))
        load_vehicle(tmp_path / "quad.yaml")


def test_mjcf_without_rotors_says_what_to_do(tmp_path):
    pytest.importorskip("mujoco", reason="pip install mujoco")
    path = tmp_path / "x.xml"
    path.write_text(MJCF[: MJCF.index("<actuator>")] + "</mujoco>")
    with pytest.raises(ValueError, match=r"no rotor found.*body_file: x\.xml"):
        load_vehicle(path)


def test_the_command_flies_it_and_says_what_it_assumed(tmp_path, capsys):
    from diffsim import cli

    (tmp_path / "mine.yaml").write_text(QUAD)
    out = tmp_path / "out"
    assert cli.main(["fly", str(tmp_path / "mine.yaml"), "--seconds", "1", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "assumed, as usual for its size: current_coefficient" in said
    assert "mine, 1.200 kg, controller lqr" in said
    assert (out / "flight.csv").is_file()


PLACES = [(0.028, 0.028), (-0.028, 0.028), (-0.028, -0.028), (0.028, -0.028)]
PYBULLET = """
<robot name="cf2">
  <properties arm="0.0397" kf="3.16e-10" km="7.94e-12" thrust2weight="2.25" prop_radius="2.3e-2"/>
  <link name="base_link"><inertial><mass value="0.027"/>
    <inertia ixx="1.4e-5" ixy="0" ixz="0" iyy="1.4e-5" iyz="0" izz="2.17e-5"/></inertial>
    <visual><geometry><mesh filename="./cf2.dae"/></geometry></visual></link>
  {links}
</robot>
"""
LINK = """
  <link name="prop{k}_link"><inertial><origin rpy="0 0 0" xyz="{x} {y} 0"/><mass value="0"/>
    <inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial></link>
  <joint name="prop{k}_joint" type="fixed"><parent link="base_link"/><child link="prop{k}_link"/>
  </joint>
"""


def stated_way(message: str) -> str:
    """The vehicle file that a refusal writes."""
    return message[message.index("{body:") :]


def test_a_urdf_with_propellers_shows_the_way(tmp_path):
    """As gym-pybullet-drones' cf2x.urdf: every link in the base's frame, no mesh beside it."""
    pytest.importorskip("mujoco", reason="pip install mujoco")
    links = "".join(LINK.format(k=k, x=x, y=y) for k, (x, y) in enumerate(PLACES))
    (tmp_path / "cf2x.urdf").write_text(PYBULLET.format(links=links))
    with pytest.raises(ValueError, match="a URDF does not say what its rotors do") as refused:
        load_vehicle(tmp_path / "cf2x.urdf")
    (tmp_path / "cf2x.yaml").write_text(stated_way(str(refused.value)))
    made = load_vehicle(tmp_path / "cf2x.yaml").vehicle
    expected = [[x, -y, 0.0] for x, y in PLACES]
    np.testing.assert_allclose(made.positions.numpy(), expected, atol=1e-12)
    assert made.spins.tolist() == [-1.0, 1.0, -1.0, 1.0]
    assert float(made.max_thrusts.sum()) == pytest.approx(2.25 * 0.027 * 9.81, rel=1e-3)
    assert made.torque_ratios[0].item() == pytest.approx(7.94e-12 / 3.16e-10, rel=1e-5)
    assert made.radii[0].item() == 0.023


WRENCH = """
<mujoco model="cf2">
  <compiler inertiafromgeom="false" meshdir="cf2" autolimits="true"/>
  <default><default class="visual"><geom type="mesh" material="black"/></default></default>
  <asset><material name="black"/><mesh file="cf2_0.obj"/></asset>
  <worldbody><body name="cf2" pos="0 0 0.1"><freejoint/>
    <inertial pos="0 0 0" mass="0.027" diaginertia="2.4e-5 2.4e-5 3.2e-5"/>
    <geom mesh="cf2_0" class="visual"/><site name="actuation"/><camera name="c"/></body></worldbody>
  <actuator>
    <motor ctrlrange="0 0.35" gear="0 0 1 0 0 0" site="actuation"/>
    <motor ctrlrange="-1e-5 1e-5" gear="0 0 0 -1 0 0" site="actuation"/>
    <motor ctrlrange="-1e-5 1e-5" gear="0 0 0 0 -1 0" site="actuation"/>
    <motor ctrlrange="-1e-5 1e-5" gear="0 0 0 0 0 -1" site="actuation"/>
  </actuator>
  <keyframe><key name="hover" qpos="0 0 0.3 1 0 0 0" ctrl="0.26 0 0 0"/></keyframe>
</mujoco>
"""


def test_a_thrust_and_moments_show_the_way(tmp_path):
    """As MuJoCo Menagerie's cf2.xml; its meshes need not be here, for it states its inertia."""
    pytest.importorskip("mujoco", reason="pip install mujoco")
    (tmp_path / "cf2.xml").write_text(WRENCH)
    with pytest.raises(ValueError, match=r"a thrust, up to 0\.35 N, and moments") as refused:
        load_vehicle(tmp_path / "cf2.xml")
    text = stated_way(str(refused.value))
    with pytest.raises(ValueError, match=r"rotors\.0\.at|rotors\[0\]\.at"):
        vehicle_from_text(text, folder=tmp_path)
    for x, y in PLACES:
        text = text.replace("[X, Y, Z]", f"[{x}, {y}, 0]", 1)
    for word, number in (("RADIUS", "0.023"), ("MAX_THRUST", "0.15"), ("TORQUE_RATIO", "0.025")):
        text = text.replace(word, number)
    made = vehicle_from_text(text, folder=tmp_path).vehicle
    assert float(made.mass) == 0.027 and made.inertia[2, 2].item() == pytest.approx(3.2e-5)


@pytest.mark.parametrize("name", ["cf2.urdf", "cf2.urdf.xacro"])
def test_macros_of_xacro_are_said(tmp_path, name):
    text = '<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:include filename="a"/></robot>'
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=r"line 1: macros of xacro, .*xacro FILE > robot.urdf"):
        load_vehicle(tmp_path / name)


def test_a_body_without_its_mass_needs_its_mesh(tmp_path):
    pytest.importorskip("mujoco", reason="pip install mujoco")
    text = MJCF.replace("</worldbody>", "</worldbody><asset><mesh file='hull.stl'/></asset>")
    text = text.replace('<body name="camera"', '<geom type="mesh" mesh="hull"/><body name="camera"')
    (tmp_path / "x.xml").write_text(text)
    load_vehicle(tmp_path / "x.xml")
    inertial = text.index("<inertial")
    (tmp_path / "x.xml").write_text(text[:inertial] + text[text.index("/>", inertial) + 2 :])
    with pytest.raises(ValueError, match=r"mesh 'hull.stl' is not beside it, and a body takes"):
        load_vehicle(tmp_path / "x.xml")
