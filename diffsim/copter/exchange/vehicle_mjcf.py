"""Mass properties and rotors of MJCF and URDF files, compiled by MuJoCo.

MuJoCo is an optional package: ``pip install mujoco``. In MJCF a rotor is a motor at a site whose
gear is (0, 0, force, 0, 0, torque), as in most vehicles of MuJoCo Menagerie. What says no rotors is
refused with the vehicle file that does, as far as it is known.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.copter.exchange.mjcf_text import refuse_impossible_inertia, refuse_too_much, whole_mjcf
from diffsim.copter.exchange.xml_nodes import Node, read_nodes
from diffsim.copter.vehicle.multicopter import GRAVITY
from diffsim.copter.vehicle.vehicle_record import (
    FRD,
    Body,
    FlyingVehicle,
    assembled,
    own_rotor,
    usual_radius,
)
from diffsim.core.arrays import Array
from diffsim.core.optional import optional

_ROTOR = re.compile(r"prop|rotor|motor", re.I)
ASSUMED = ("nominal_voltage", "radius")  # of rotors: MJCF does not say them
_PROPERTIES = ("kf", "km", "thrust2weight", "prop_radius")  # of gym-pybullet-drones


def body_of(path: Path) -> Body:
    """Mass, inertia, center of mass and named places of the first body that moves.

    Args:
        path: MJCF (``.xml``) or URDF.

    Raises:
        FileNotFoundError: no such file.
        ValueError: MuJoCo refuses it, or nothing in it moves.
        ImportError: MuJoCo is not installed.
    """
    return _body(*_compile_model(path), path)


def vehicle_of_mjcf(path: Path) -> FlyingVehicle:
    """A multicopter whose rotors are motors at sites.

    Returns:
        The vehicle. Radii are assumed from the distances of the rotors: MJCF does not say them.

    Raises:
        ValueError: no such motors, or what ``body_of`` refuses.
        ImportError: MuJoCo is not installed.
    """
    mujoco, model, data = _compile_model(path)
    body = _body(mujoco, model, data, path)
    _refuse_wrench(path, model)
    places, axes, spins, motors = [], [], [], []
    for k in range(model.nu):
        gear = model.actuator_gear[k]
        is_site = model.actuator_trntype[k] == mujoco.mjtTrn.mjTRN_SITE
        if not is_site or gear[2] == 0.0 or np.any(gear[[0, 1, 3, 4]]):
            continue
        site = model.site(model.actuator_trnid[k, 0])
        push = float(model.actuator_gainprm[k, 0] * gear[2])
        limit = float(model.actuator_ctrlrange[k, 1])
        name = model.actuator(k).name or f"actuator {k}"
        if not model.actuator_ctrllimited[k] or not push * limit > 0.0:
            raise ValueError(
                f"{path}: motor {name!r} needs a ctrlrange up to its greatest thrust, such as "
                '"0 13"'
            )
        if gear[5] == 0.0:
            raise ValueError(f"{path}: motor {name!r} has no torque in its gear: spin unknown")
        places.append(body.places[site.name or f"site {site.id}"])
        axes.append(np.sign(gear[2]) * body.axes[site.name or f"site {site.id}"])
        spins.append(float(np.sign(gear[5] / gear[2])))
        motors.append((abs(push) * limit, abs(float(gear[5] / gear[2]))))
    if not motors:
        raise ValueError(
            f"{path}: no rotor found: none of its {model.nu} actuators at sites is a motor with "
            f"gear (0, 0, force, 0, 0, torque); {_way(path, [])}"
        )
    if len(motors) == 1:
        raise ValueError(f"{path}: one rotor only; its radius is not known from distances")
    radius = usual_radius(np.array(places))
    rotors = tuple(
        own_rotor(radius=radius, max_thrust=push, torque_ratio=ratio, assumed=ASSUMED)
        for push, ratio in motors
    )
    name = ElementTree.parse(path).getroot().get("model") or path.stem
    return assembled(body, FRD, places, axes, spins, rotors, None, name, str(path))


def vehicle_of_urdf(path: Path) -> FlyingVehicle:
    """No multicopter: a URDF does not say what its rotors do.

    Raises:
        ValueError: always, with the vehicle file to write, whose places are those of links that
            are called propeller, rotor or motor, and whose numbers those that PyBullet's drones
            state in ``<properties>``.
    """
    mujoco, model, data = _compile_model(path)
    body = _body(mujoco, model, data, path)
    # a link may lie in its rotor, or keep the base's frame, which is the world's of a URDF, and
    # state where its mass would be
    rotors = (b for b in range(1, model.nbody) if _ROTOR.search(model.body(b).name))
    places = [data.xipos[b] for b in rotors]
    known: dict[str, float] = {}
    for stated in read_nodes(path).all("properties"):
        known |= {k: stated.numbers(k, 1)[0] for k in _PROPERTIES if k in stated.attributes}
    if len(places) > 1 and "thrust2weight" in known:
        weight = body.mass * GRAVITY
        known["max_thrust"] = float(f"{known['thrust2weight'] * weight / len(places):.6g}")
    if known.get("kf"):
        known["torque_ratio"] = float(f"{known.get('km', 0.0) / known['kf']:.6g}")
    raise ValueError(f"{path}: a URDF does not say what its rotors do; {_way(path, places, known)}")


def _way(path: Path, places: list[Array], known: Mapping[str, float] | None = None) -> str:
    """The vehicle file to write: what is not known stands in capitals."""
    spins = ("ccw", "cw")
    at = [f"[{', '.join(f'{x:.4g}' for x in place + 0.0)}]" for place in places]
    rotors = [f"{{at: {p}, spin: {spins[k % 2]}}}" for k, p in enumerate(at or ["[X, Y, Z]"] * 4)]
    known = dict(known or {})
    if "prop_radius" in known:
        known["radius"] = known["prop_radius"]
    elif len(places) > 1:
        known["radius"] = float(f"{usual_radius(np.array(places)):.3g}")
    facts = ("radius", "max_thrust", "torque_ratio")
    rotor = ", ".join(f"{fact}: {known.get(fact, fact.upper())}" for fact in facts)
    return (
        "write a vehicle file (YAML) beside it, check the spins and what stands in capitals: "
        f"{{body: FLU, body_file: {path.name}, rotors: [{', '.join(rotors)}], rotor: {{{rotor}}}}}"
    )


def _refuse_wrench(path: Path, model: Any) -> None:
    """A thrust and moments at the body, as a controller asks for them, are no rotors."""
    gears = model.actuator_gear
    pushes = (gears[:, 2] != 0.0) & ~gears[:, 3:].any(axis=1)
    turns = gears[:, 3:].any(axis=1) & ~gears[:, :3].any(axis=1)
    if pushes.any() and turns.any():
        limits = np.abs(model.actuator_ctrlrange * model.actuator_gainprm[:, :1]).max(axis=1)
        thrust = (limits * np.abs(gears[:, 2]))[pushes].sum()
        raise ValueError(
            f"{path}: no rotor found: its actuators are a thrust, up to {thrust:g} N, and moments, "
            f"which stand for rotors; {_way(path, [])}"
        )


def _refuse_xacro(node: Node) -> None:
    if node.tag.startswith("xacro:") or any("${" in v for v in node.attributes.values()):
        raise node.error("macros of xacro, which ROS expands: xacro FILE > robot.urdf")
    for child in node.children:
        _refuse_xacro(child)


def _compile_model(path: Path) -> tuple[Any, Any, Any]:
    """The module, the compiled model, and its state at rest."""
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}")
    _refuse_xacro(read_nodes(path))  # refuses what is over the bounds of files of strangers, too
    mujoco: Any = optional("mujoco", purpose=f"reading {path.name}")
    try:
        text, meshes = (_urdf(path), {}) if path.suffix == ".urdf" else whole_mjcf(path)
        model = mujoco.MjModel.from_xml_string(text, meshes)
    except (ValueError, ElementTree.ParseError) as error:
        raise ValueError(f"{path}: {error}") from error
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return mujoco, model, data


def _urdf(path: Path) -> str:
    """The same robot without shapes, whose files need not be here, every link a body.

    Raises:
        ValueError: the file is no robot.
    """
    robot = ElementTree.parse(path).getroot()
    if robot.tag != "robot":
        raise ValueError(f"URDF begins with <robot>, got <{robot.tag}>")
    for link in robot.findall("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    for further in [*robot.findall("mujoco"), *robot.findall("include")]:
        robot.remove(further)  # MuJoCo would follow these, too
    refuse_too_much(robot)
    refuse_impossible_inertia(robot)
    compiler = ElementTree.SubElement(ElementTree.SubElement(robot, "mujoco"), "compiler")
    compiler.set("fusestatic", "false")  # links that are welded on keep their names
    return ElementTree.tostring(robot, encoding="unicode")


def _body(mujoco: Any, model: Any, data: Any, path: Path) -> Body:
    free = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    tops = np.flatnonzero(model.body_parentid[1:] == 0) + 1
    movers = tops if path.suffix == ".urdf" else free  # MuJoCo welds a URDF's root to the world
    if len(movers) != 1:
        raise ValueError(
            f"{path}: needs one body with a free joint, the vehicle; it has {len(movers)}"
        )
    root = int(movers[0])
    members = [b for b in range(model.nbody) if model.body_rootid[b] == model.body_rootid[root]]
    turn, origin = data.xmat[root].reshape(3, 3).T, data.xpos[root]
    masses = model.body_mass[members]
    centers = (data.xipos[members] - origin) @ turn.T
    if not masses.sum() > 0.0:
        raise ValueError(f"{path}: the vehicle has no mass")
    center = masses @ centers / masses.sum()
    inertia = np.zeros((3, 3))
    for b, mass, place in zip(members, masses, centers - center, strict=True):
        frame = turn @ data.ximat[b].reshape(3, 3)
        inertia += frame @ np.diag(model.body_inertia[b]) @ frame.T
        inertia += mass * (place @ place * np.eye(3) - np.outer(place, place))
    places, axes = {}, {}
    for b in members:
        name = model.body(b).name
        places[name] = turn @ (data.xpos[b] - origin)
        axes[name] = turn @ data.xmat[b].reshape(3, 3)[:, 2]
    for s in range(model.nsite):
        if model.site_bodyid[s] in members:
            name = model.site(s).name or f"site {s}"
            places[name] = turn @ (data.site_xpos[s] - origin)
            axes[name] = turn @ data.site_xmat[s].reshape(3, 3)[:, 2]
    return Body(float(masses.sum()), inertia, center, places, axes)
