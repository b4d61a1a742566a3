"""Frames of an SDF model (sdformat.org): where every link is, whatever its pose is relative to."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from diffsim.copter.exchange.xml_nodes import Node
from diffsim.core.arrays import Array
from diffsim.core.check import did_you_mean

Pose = tuple[Array, Array]  # turn (3, 3) and place (3,) [m]

_HERE = (np.eye(3), np.zeros(3))
_NEW_ORIGIN = "placement_frame"


@dataclass
class Frames:
    """Links of a model and of the models in it, by names such as ``arm::motor``.

    Attributes:
        links: The elements of the links.
    """

    links: dict[str, Node] = field(default_factory=dict)
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
