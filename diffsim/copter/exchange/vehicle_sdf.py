"""Multicopters of SDF files (Gazebo), read without Gazebo.

All links are one rigid body; rotors are the motor models, plugins that state ``motorConstant``
[N s^2/rad^2], ``momentConstant`` [m], ``maxRotVelocity`` [rad/s] and ``turningDirection``, as
``gz-sim-multicopter-motor-model-system`` and ``libgazebo_motor_model.so`` do. A rotor pushes along
its link's z axis. Shapes, sensors, drag and rolling moments are not read.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from diffsim.copter.exchange.xml_nodes import Node, read_nodes
from diffsim.copter.vehicle.rotor import RotorModel
from diffsim.copter.vehicle.vehicle_record import (
    FRD,
    Body,
    FlyingVehicle,
    assembled,
    own_rotor,
    usual_radius,
)
from diffsim.core.arrays import Array
from diffsim.core.check import did_you_mean
from diffsim.core.inertia import ENTRIES, inertia_matrix, inertia_mistake

_SPINS = {"cw": 1.0, "ccw": -1.0}


@dataclass(frozen=True)
class _Motor:
    """A motor model: its link, spin, thrust at full speed [N], and what a rotor is made of."""

    link: str
    spin: float
    max_thrust: float
    torque_ratio: float
    max_speed: float
    time_constant: float
    lags_differ: bool
    radius: float | None


def sdf_body(path: Path) -> Body:
    """Mass, inertia and center of mass of all links, and where they are, in the model's frame.

    Args:
        path: SDF file of one model, or of a world with one model that moves.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not such a file, by line; links without mass; other files are included.
    """
    return _body(Frames.of(_model(path)))


def vehicle_of_sdf(path: Path) -> FlyingVehicle:
    """A multicopter whose rotors are Gazebo's motor models.

    Returns:
        The vehicle. A rotor's radius is that of its link's collision shape; without one it is
        assumed from the distances of the rotors. The lag is the longer one, up or down.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no motor models, or what ``sdf_body`` refuses.
    """
    model = _model(path)
    frames = Frames.of(model)
    body = _body(frames)
    motors = [_motor(plugin, frames) for plugin in _plugins(model)]
    if not motors:
        raise ValueError(
            f"{path}: no rotor found: no plugin states motorConstant; write a vehicle file with "
            f"body_file: {path.name} and rotors with body: NAME, spin"
        )
    places = [body.places[m.link] for m in motors]
    if len(motors) == 1 and motors[0].radius is None:
        raise ValueError(f"{path}: one rotor only, of a link without a cylinder or box: no radius")
    radius = 0.0 if len(motors) == 1 else usual_radius(np.array(places))
    rotors = tuple(_rotor(motor, radius) for motor in motors)
    axes, spins = [body.axes[m.link] for m in motors], [m.spin for m in motors]
    name = model.attributes.get("name") or path.stem
    return assembled(body, FRD, places, axes, spins, rotors, None, name, str(path))


def _model(path: Path) -> Node:
    """The one model of a file that moves."""
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}")
    root = read_nodes(path)
    if root.tag != "sdf":
        raise root.error(f"SDF begins with <sdf>, got <{root.tag}>")
    models = [m for place in (root, *root.all("world")) for m in place.all("model")]
    moving = [m for m in models if not _is_static(m)]
    if len(moving) != 1:
        names = ", ".join(m.attributes.get("name", "?") for m in moving) or "none"
        raise root.error(f"needs one <model> that moves, the vehicle; it has {names}")
    return moving[0]


def _is_static(model: Node) -> bool:
    said = model.one("static")
    return said is not None and said.content.strip() in ("true", "1")


def _body(frames: Frames) -> Body:
    parts = []
    places, axes = {}, {}
    for name, link in frames.links.items():
        turn, place = frames.pose(name)
        places[name], axes[name] = place, turn[:, 2]
        parts.append(_inertial(link, turn, place))
    if not parts:
        raise ValueError("the model has no links")
    masses = np.array([mass for mass, _, _ in parts])
    centers = np.array([center for _, center, _ in parts])
    center = masses @ centers / masses.sum()
    inertia = np.zeros((3, 3))
    for (mass, _, own), arm in zip(parts, centers - center, strict=True):
        inertia += own + mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))  # Steiner
    return Body(float(masses.sum()), inertia, center, places, axes)


def _inertial(link: Node, turn: Array, place: Array) -> tuple[float, Array, Array]:
    """Mass, center of mass and inertia about it, axes of the model."""
    said = link.one("inertial")
    if said is None or said.one("mass") is None:
        raise link.error(
            f"link {link.attributes['name']!r} states no mass; Gazebo would take 1 kg: give "
            "<inertial><mass>"
        )
    if said.attributes.get("auto", "false") in ("true", "1"):
        raise said.error("auto inertia is computed by Gazebo; write its numbers: gz sdf -p FILE")
    if said.one("fluid_added_mass") is not None:
        raise said.error("<fluid_added_mass> is not supported for vehicles of the air")
    mass = said.value("mass")
    if not mass > 0.0:
        raise said.error(f"<mass> must be above 0, got {mass:g}")
    tensor = said.one("inertia")
    if tensor is None:
        raise said.error("<inertial> needs <inertia>")
    entries = [tensor.value(e, 0.0 if e[1] != e[2] else None) for e in ENTRIES]
    if mistake := inertia_mistake(entries, [f"<{e}>" for e in ENTRIES]):
        raise tensor.error(f"link {link.attributes['name']!r}: {mistake}")
    own_turn, own_place = pose_of(said)
    frame = turn @ own_turn
    inertia = frame @ inertia_matrix(entries) @ frame.T
    return mass, turn @ own_place + place, inertia


def _plugins(model: Node) -> list[Node]:
    """Motor models of a model and of those in it."""
    own = [p for p in model.all("plugin") if p.one("motorConstant") is not None]
    return own + [p for inner in model.all("model") for p in _plugins(inner)]


def _motor(plugin: Node, frames: Frames) -> _Motor:
    link = plugin.one("linkName")
    if link is None:
        raise plugin.error("the motor model needs <linkName>")
    stated = link.content.strip()
    named = [n for n in frames.links if n == stated or n.endswith(f"::{stated}")]
    if stated in named:
        named = [stated]
    if len(named) != 1:
        hint = did_you_mean(stated, frames.links)
        raise link.error(f"{len(named)} links are called {stated!r}{hint}")
    spin = plugin.one("turningDirection")
    said = "" if spin is None else spin.content.strip()
    (spin or plugin).require_choice("turningDirection", said, _SPINS)
    kind = plugin.one("motorType")
    if kind is not None:
        kind.require_choice("motorType", kind.content.strip(), ["velocity"])
    speed = plugin.value("maxRotVelocity")
    numbers = {
        "maxRotVelocity": speed,
        "motorConstant": plugin.value("motorConstant"),
        "momentConstant": plugin.value("momentConstant"),
    }
    for name, number in numbers.items():
        if not number > 0.0:
            raise plugin.error(f"<{name}> must be above 0, got {number:g}")
    lags = [plugin.value(f"timeConstant{way}", 0.0) for way in ("Up", "Down")]
    return _Motor(
        link=named[0],
        spin=_SPINS[said],
        max_thrust=numbers["motorConstant"] * speed**2,
        torque_ratio=numbers["momentConstant"],
        max_speed=speed,
        time_constant=max(lags),
        lags_differ=lags[0] != lags[1],
        radius=_radius(frames.links[named[0]]),
    )


def _radius(link: Node) -> float | None:
    """Radius of a rotor's collision shape: a cylinder, or a box around the blades [m]."""
    found = []
    for collision in link.all("collision"):
        geometry = collision.one("geometry")
        shape = None if geometry is None else geometry.one("cylinder")
        if shape is not None:
            found.append(shape.value("radius"))
        box = None if geometry is None else geometry.one("box")
        size = None if box is None else box.one("size")
        if size is not None:
            found.append(0.5 * max(size.content_numbers(3)))
    return max(found, default=None)


def _rotor(motor: _Motor, usual: float) -> RotorModel:
    assumed = ["nominal_voltage", *(["radius"] if motor.radius is None else [])]
    assumed += ["time_constant"] if motor.lags_differ else []
    return own_rotor(
        radius=usual if motor.radius is None else motor.radius,
        max_thrust=motor.max_thrust,
        torque_ratio=motor.torque_ratio,
        max_speed=motor.max_speed,
        time_constant=motor.time_constant if motor.time_constant > 0.0 else None,
        assumed=assumed,
    )


Pose = tuple[Array, Array]  # turn (3, 3) and place (3,) [m]

_HERE = (np.eye(3), np.zeros(3))
_NEW_ORIGIN = "placement_frame"


@dataclass
class Frames:
    """Links of a model and of the models in it, by names such as ``arm::motor``."""

    links: dict[str, Node] = field(default_factory=dict)  # the elements of the links
    _stated: dict[str, tuple[str, Pose, Node]] = field(default_factory=dict)

    @staticmethod
    def of(model: Node) -> Frames:
        """Frames of a ``<model>``, whose own pose in the world is left out.

        Raises:
            ValueError: names that stand twice, other files, or what is not supported, by line.
        """
        frames = Frames()
        frames._add(model, "")
        return frames

    def pose(self, name: str) -> Pose:
        """Turn and place of a frame in that of the model.

        Raises:
            ValueError: it is relative to itself, or to what there is not.
        """
        turn, place = _HERE
        seen: list[str] = []
        while name:
            if name in seen:
                where = self._stated[name][2]
                raise where.error(f"poses go in a circle: {' -> '.join([*seen, name])}")
            seen.append(name)
            parent, (own_turn, own_place), node = self._stated[name]
            turn, place = own_turn @ turn, own_turn @ place + own_place
            if parent and parent not in self._stated:
                hint = did_you_mean(parent, self._stated)
                raise node.error(f"<{node.tag}> is relative to {parent!r}, which is not here{hint}")
            name = parent
        return turn, place

    def _add(self, model: Node, scope: str) -> None:
        if model.all("include"):
            raise model.all("include")[0].error(
                "<include> reads another file, which is not done here; write one file with "
                "gz sdf -p FILE > whole.sdf"
            )
        if _NEW_ORIGIN in model.attributes:
            raise model.error(f"{_NEW_ORIGIN} of <model> is not supported; give its pose instead")
        for node in model.children:
            if node.tag not in ("link", "frame", "joint", "model"):
                continue
            name = _inner(scope, node.text("name"))
            if name in self._stated:
                raise node.error(f"the name {name!r} stands twice")
            pose = node.one("pose")
            base = _base(node) if pose is None else pose.attributes.get("relative_to", _base(node))
            parent = scope if base in ("", "__model__") else _inner(scope, base)
            self._stated[name] = (parent, _HERE if pose is None else _pose(pose), node)
            if node.tag == "link":
                self.links[name] = node
            if node.tag == "model":
                self._add(node, name)


def pose_of(node: Node) -> Pose:
    """The pose that an element such as ``<inertial>`` states in its link; none: the link's own."""
    pose = node.one("pose")
    if pose is None:
        return _HERE
    if pose.attributes.get("relative_to"):
        raise pose.error(f"relative_to of the pose of <{node.tag}> is not supported")
    return _pose(pose)


def _base(node: Node) -> str:
    """What a pose is relative to where it does not say."""
    if node.tag == "frame":
        return node.attributes.get("attached_to", "")
    child = node.one("child") if node.tag == "joint" else None
    return "" if child is None else child.content.strip()


def _inner(scope: str, name: str) -> str:
    return f"{scope}::{name}" if scope else name


def _pose(pose: Node) -> Pose:
    """x y z roll pitch yaw about fixed axes, or x y z and a quaternion."""
    if not pose.content.strip():
        return _HERE
    form = pose.attributes.get("rotation_format", "euler_rpy")
    pose.require_choice("rotation_format", form, ["euler_rpy", "quat_xyzw"])
    numbers = np.array(pose.content_numbers(6 if form == "euler_rpy" else 7))
    if form == "quat_xyzw":
        if not np.linalg.norm(numbers[3:]) > 0.0:
            raise pose.error("the quaternion of a pose must not be zero")
        return Rotation.from_quat(numbers[3:]).as_matrix(), numbers[:3]
    degrees = pose.attributes.get("degrees", "false")
    pose.require_choice("degrees", degrees, ["true", "false", "1", "0"])
    turn = Rotation.from_euler("xyz", numbers[3:], degrees=degrees in ("true", "1"))
    return turn.as_matrix(), numbers[:3]
