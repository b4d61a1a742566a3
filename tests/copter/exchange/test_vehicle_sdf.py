"""Multicopters of SDF files: closed forms, the same vehicle as URDF, and what is refused."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from diffsim import cli
from diffsim.copter import hover, load_vehicle
from diffsim.copter.exchange.vehicle_sdf import sdf_body

SHAPE = (
    "<collision name='c'><geometry><cylinder><length>0.01</length><radius>0.12</radius></cylinder>"
    "</geometry></collision>"
)


def inertial(mass, ixx, iyy, izz, pose="0 0 0 0 0 0"):
    return (
        f"<inertial><pose>{pose}</pose><mass>{mass}</mass><inertia><ixx>{ixx}</ixx>"
        f"<iyy>{iyy}</iyy><izz>{izz}</izz></inertia></inertial>"
    )


def rotor(k, pose, spin, more=""):
    return (
        f"<link name='rotor_{k}'><pose {more}>{pose}</pose>{inertial(0.05, 1e-5, 1e-5, 2e-5)}"
        f"{SHAPE}</link>"
        f"<joint name='j{k}' type='revolute'><parent>base</parent><child>rotor_{k}</child></joint>"
        f"<plugin filename='gz-sim-multicopter-motor-model-system' name='x'>"
        f"<linkName>rotor_{k}</linkName><turningDirection>{spin}</turningDirection>"
        "<timeConstantUp>0.02</timeConstantUp><timeConstantDown>0.02</timeConstantDown>"
        "<maxRotVelocity>1000</maxRotVelocity><motorConstant>6e-6</motorConstant>"
        "<momentConstant>0.016</momentConstant></plugin>"
    )


BASE = f"<link name='base'>{inertial(1.0, 0.01, 0.011, 0.018, '0.01 0 0 0 0 0')}</link>"
PLACES = ((0.2, -0.2, "ccw"), (-0.2, 0.2, "ccw"), (0.2, 0.2, "cw"), (-0.2, -0.2, "cw"))
ROTORS = "".join(rotor(k, f"{x} {y} 0.03 0 0 0", s) for k, (x, y, s) in enumerate(PLACES))


def sdf(tmp_path, inner, name="quad.sdf"):
    path = tmp_path / name
    path.write_text(
        "<?xml version='1.0'?><sdf version='1.9'>"
        f"<model name='quad'><pose>0 0 9 0 0 1</pose>{inner}</model></sdf>"
    )
    return path


def test_numbers_of_a_quadrotor(tmp_path):
    made = load_vehicle(sdf(tmp_path, BASE + ROTORS))
    vehicle = made.vehicle
    assert made.name == "quad" and float(vehicle.mass) == pytest.approx(1.2)
    center = np.array([0.01, 0.0, 0.2 * 0.03]) / 1.2
    expected = np.array([0.2, -0.2, 0.03]) - center
    assert vehicle.positions[0].tolist() == pytest.approx((expected * [1, -1, -1]).tolist())
    assert vehicle.directions[0].tolist() == [0.0, 0.0, -1.0]
    assert vehicle.spins.tolist() == [-1.0, -1.0, 1.0, 1.0]
    assert vehicle.max_thrusts.tolist() == pytest.approx([6.0] * 4)
    assert vehicle.torque_ratios.tolist() == [0.016] * 4 and vehicle.radii.tolist() == [0.12] * 4
    assert made.rotors[0].time_constant == 0.02 and "radius" not in made.assumed
    zz = 0.018 + 1.0 * (0.01 - center[0]) ** 2
    zz += sum(2e-5 + 0.05 * ((x - center[0]) ** 2 + y**2) for x, y, _ in PLACES)
    assert float(vehicle.inertia[2, 2]) == pytest.approx(zz)
    assert float(hover(vehicle).thrusts.sum()) == pytest.approx(1.2 * 9.81)


def test_mass_properties_as_mujoco_computes_them_from_urdf(tmp_path):
    pytest.importorskip("mujoco", reason="pip install mujoco")
    from diffsim.copter.exchange.vehicle_mjcf import body_of

    poses = ["0.2 -0.1 0.03 0.3 -0.2 0.5", "-0.3 0.15 0.1 -1 0.4 2"]
    links, joints = "", ""
    for k, pose in enumerate(poses):
        xyz, rpy = pose.split()[:3], pose.split()[3:]
        links += (
            f'<link name="rotor_{k}"><inertial><mass value="0.05"/><inertia ixx="1e-5" iyy="1e-5" '
            'izz="2e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )
        joints += (
            f'<joint name="j{k}" type="continuous"><parent link="base"/><child link="rotor_{k}"/>'
            f'<origin xyz="{" ".join(xyz)}" rpy="{" ".join(rpy)}"/><axis xyz="0 0 1"/></joint>'
        )
    (tmp_path / "a.urdf").write_text(
        '<robot name="q"><link name="base"><inertial><origin xyz="0.01 0 0"/><mass value="1"/>'
        '<inertia ixx="0.01" iyy="0.011" izz="0.018" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        f"{links}{joints}</robot>"
    )
    ours = sdf_body(sdf(tmp_path, BASE + rotor(0, poses[0], "cw") + rotor(1, poses[1], "cw")))
    theirs = body_of(tmp_path / "a.urdf")
    assert ours.mass == pytest.approx(theirs.mass)
    np.testing.assert_allclose(ours.center_of_mass, theirs.center_of_mass, atol=1e-12)
    np.testing.assert_allclose(ours.inertia, theirs.inertia, atol=1e-9)
    np.testing.assert_allclose(ours.axes["rotor_1"], theirs.axes["rotor_1"], atol=1e-9)


def test_poses_relative_to_other_frames(tmp_path):
    inner = (
        f"{BASE}<frame name='arm' attached_to='base'><pose degrees='true'>0.1 0 0 0 0 90</pose>"
        "</frame><frame name='tip'><pose relative_to='arm'>0.2 0 0 0 0 0</pose></frame>"
        f"<model name='pod'><pose relative_to='tip'>0 0 0.5 0 0 0</pose>"
        f"{rotor(7, '1 0 0 0 0 0 1', 'cw', chr(114) + 'otation_format=' + repr('quat_xyzw'))}"
        "</model>"
    )
    body = sdf_body(sdf(tmp_path, inner))
    # 0.1 along x, a quarter turn to the left, 0.2 ahead, 0.5 up, 1 ahead
    assert body.places["pod::rotor_7"].tolist() == pytest.approx([0.1, 1.2, 0.5])
    turned = sdf_body(sdf(tmp_path, BASE + rotor(0, "0 0 0 0.1 0.2 0.3", "cw")))
    about_fixed_axes = Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix()[:, 2]
    assert turned.axes["rotor_0"].tolist() == pytest.approx(about_fixed_axes.tolist())


BOMB = "<!DOCTYPE a [<!ENTITY b 'xxxxxxxxxx'><!ENTITY c '&b;&b;&b;'>]>"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("<motorConstant>6e-6</motorConstant>", "", "no rotor found.*body_file: quad.sdf"),
        (">ccw<", ">left<", r"line 1: turningDirection must be one of \['cw', 'ccw'\]"),
        ("<linkName>rotor_0", "<linkName>rotor_9", "0 links are called 'rotor_9'; did you mean"),
        ("<mass>1.0</mass>", "", "link 'base' states no mass; Gazebo would take 1 kg"),
        ("<mass>1.0</mass>", "<mass>-1</mass>", "<mass> must be above 0, got -1"),
        ("<ixx>0.01</ixx>", "<ixx>much</ixx>", "must be 1 numbers: could not convert"),
        ("<link name='base'>", "<include/><link name='base'>", "gz sdf -p"),
        ("<link name='rotor_1'>", "<link name='rotor_0'>", "'rotor_0' stands twice"),
        ("<pose >0.2 -0.2", "<pose relative_to='rotor_0'>0.2 -0.2", "poses go in a circle"),
        ("<pose >0.2 -0.2", "<pose relative_to='bse'>0.2 -0.2", "'bse', which.*mean 'base'"),
        ("<sdf version", BOMB + "<sdf version", "a document type .* is not read"),
        ("<model name", "<model name='b'/><model name", "needs one <model> that moves.*b, quad"),
        ("<sdf version='1.9'>", "<robot>", "not XML: mismatched tag"),
    ],
)
def test_mistakes_name_the_line(tmp_path, old, new, words):
    path = sdf(tmp_path, BASE + ROTORS)
    whole = path.read_text()
    assert old in whole
    count = -1 if "motorConstant" in old else 1
    path.write_text(whole.replace(old, new, count))
    with pytest.raises(ValueError, match=words):
        load_vehicle(path)


def test_bounds_of_xml(tmp_path):
    path = sdf(tmp_path, BASE + "<frame>" * 60 + "</frame>" * 60)
    with pytest.raises(ValueError, match="more than 50 levels"):
        load_vehicle(path)
    path.write_text("<sdf>" + " " * 20_000_001 + "</sdf>")
    with pytest.raises(ValueError, match="at most 20,000,000 bytes"):
        load_vehicle(path)
    (tmp_path / "x.xml").write_text(BOMB + "<mujoco/>")
    with pytest.raises(ValueError, match="a document type"):
        load_vehicle(tmp_path / "x.xml")


def test_it_serves_vehicle_files_and_the_command(tmp_path):
    sdf(tmp_path, BASE + ROTORS.replace("motorConstant", "other"))
    rows = "".join(f"  - {{body: rotor_{k}, spin: {s}}}\n" for k, (*_, s) in enumerate(PLACES))
    text = f"body: FLU\nbody_file: quad.sdf\nrotors:\n{rows}rotor: {{model: kde2814_10in}}\n"
    (tmp_path / "quad.yaml").write_text(text)
    named = load_vehicle(tmp_path / "quad.yaml").vehicle
    whole = sdf(tmp_path, BASE + ROTORS, "whole.sdf")
    assert torch.equal(named.positions, load_vehicle(whole).vehicle.positions)
    out = tmp_path / "out"
    assert cli.main(["fly", str(whole), "--seconds", "1", "--out", str(out)]) == 0
    assert (out / "flight.csv").is_file()
