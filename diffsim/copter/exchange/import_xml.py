"""Designs of the public tool (mit-gfx/multicopter_design): XML beside OBJ meshes and bench tables.

The XML places every part and says nothing about which touch which; the links are inferred from the
geometry: a connector whose bore holds a tube slides on it; connectors face to face keep their
distance, and so do a motor and the connector under it; a connector on a plate stays. Plates,
battery and electronics stay where they are. Propellers carry no mass there.

A tag or attribute that is not known is an error: one public file once held ``<translat``, which
the tool drops without a word.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from diffsim.copter.design.design import Design, build_design
from diffsim.copter.design.spec import Connection, DesignSpec, PartSpec
from diffsim.copter.exchange.xml_nodes import Node, read_nodes
from diffsim.copter.vehicle.geometry import rotation_rpy
from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.core.errors import MeshError
from diffsim.core.inside import inside
from diffsim.mesh.files import load_surface

if TYPE_CHECKING:
    import trimesh


ROTOR_OF_MEASUREMENT = {
    "motor_10inch_prop.txt": "kde2814_10in",
    "motor_14inch_prop.txt": "kde2814_14in",
}
_TAGS = {  # tag -> part name, allowed attributes of the tag, of its instances
    "plate": ("plate", {"file", "density"}, {"size"}),
    "battery": ("battery", {"file", "density", "capacity"}, set()),
    "electronics": ("electronics", {"file", "density"}, set()),
    "tube": ("tube", {"file", "density"}, {"length"}),
    "round_connector": ("connector", {"file", "density"}, set()),
    "motor": (
        "rotor",
        {"file", "density", "measurement", "propeller_height"},
        {"spin_dir", "flip_prop"},
    ),
    "propeller": ("propeller", {"file"}, set()),
}


@checked
def import_xml(path: str | Path) -> Design:
    """Read a design of the public tool.

    Args:
        path: The XML; mesh files are looked for beside it and in ``mesh/``.

    Returns:
        The design, in the XML's frame (NED). Parts are named ``tube_0``, ``connector_0``,
        ``rotor_0``, ... in the order of the file.

    Raises:
        FileNotFoundError: no such XML or mesh.
        ValueError: a mesh outside of the design's folder, unknown tags or attributes (with the line
            and the closest name), missing values, numbers that cannot be read.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no XML design {path}")
    root = read_nodes(path)
    if root.tag != "copter":
        raise root.error(f"the root must be <copter>, got <{root.tag}>")
    parts = [p for node in root.children for p in _parts(node, path)]
    links = Links(parts, path.parent)
    spec = DesignSpec(
        name=path.stem,
        notes=f"imported from {path.name}",
        parts=tuple(replace(p, anchored=True) if p.name in links.anchored else p for p in parts),
        connections=tuple(links.on_tubes),
        rigid=tuple(links.rigid),
        folder=path.parent,
    )
    return build_design(spec)


def _parts(node: Node, path: Path) -> list[PartSpec]:
    """The instances of a tag; a tag without instances is its own."""
    stem, attributes, of_instance = _TAGS[node.require_choice("tag", node.tag, _TAGS)]
    instances = [child for child in node.children if child.tag == "instance"]
    if not instances:
        node.require_attributes(attributes | of_instance)
    else:
        node.require_attributes(attributes)
    if stem == "propeller":
        return []
    moves = [child for child in node.children if child.tag != "instance"]
    for child in moves:
        child.require_choice("tag", child.tag, ["instance", "translate", "rotate"])
    if instances and moves:
        raise moves[0].error(f"<{moves[0].tag}> must stand inside an <instance>")
    result = []
    for k, instance in enumerate(instances or [node]):
        if instances:
            instance.require_attributes(of_instance)
        name = stem if not instances else f"{stem}_{k}"
        rotation, place = _transform(instance)
        kind, options = _options(node, instance, path)
        fixed = stem in ("plate", "battery", "electronics")
        result.append(
            PartSpec(
                name=name,
                kind=kind,
                options=options,
                rotation=rotation,
                place=place,
                anchored=fixed,
            )
        )
    return result


def _options(node: Node, instance: Node, path: Path) -> tuple[str, dict[str, Any]]:
    options: dict[str, Any] = {
        "file": _mesh_file(node, path),
        "density": node.numbers("density", 1)[0],
    }
    if node.tag == "tube":
        return "imported_rod", options | {"length": instance.numbers("length", 1)[0]}
    if node.tag == "plate":
        return "imported_mesh", options | {"scale": (*instance.numbers("size", 2), 1.0)}
    if node.tag != "motor":
        return "imported_mesh", options
    table = node.text("measurement")
    rotor = node.require_choice("measurement", table, ROTOR_OF_MEASUREMENT)
    flip = instance.attributes.get("flip_prop", "false")
    instance.require_choice("flip_prop", flip, ["true", "false"])
    spin = instance.text("spin_dir")
    instance.require_choice("spin_dir", spin, ["cw", "ccw"])
    return "imported_motor", options | {
        "rotor": ROTOR_OF_MEASUREMENT[rotor],
        "spin": spin,
        "flip_prop": flip == "true",
    }


def _mesh_file(node: Node, path: Path) -> str:
    name = node.text("file")
    for candidate in (name, f"mesh/{name}"):
        try:
            if inside(path.parent, candidate, "file").is_file():
                return candidate
        except ValueError as error:
            raise node.error(str(error)) from None
    raise FileNotFoundError(
        f"{node.where}: no mesh {name} beside {path.name} or in {path.parent / 'mesh'}"
    )


def _transform(instance: Node) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Roll, pitch, yaw [deg] and translation [m] of the moves in file order."""
    turns, rotation, place = [], np.eye(3), np.zeros(3)
    for move in instance.children:
        move.require_choice("tag", move.tag, ["translate", "rotate"])
        if move.tag == "translate":
            move.require_attributes({"xyz"})
            place = place + move.numbers("xyz", 3)
        else:
            move.require_attributes({"rpy"})
            turns.append(move.numbers("rpy", 3))
            turn = rotation_rpy(turns[-1])
            rotation, place = turn @ rotation, turn @ place
    if len(turns) <= 1:
        return tuple(turns[0]) if turns else (0.0, 0.0, 0.0), tuple(place.tolist())
    angles = Rotation.from_matrix(rotation).as_euler("xyz", degrees=True)
    return tuple(angles.tolist()), tuple(place.tolist())


_GAP = 0.003  # parts closer than this touch; the tool's designs leave up to 2.4 mm [m]
_ASIDE = 1e-3  # and their centers are on one line up to this [m]


class Links:
    """Which parts touch, inferred from their boxes, each turned as its part is.

    Attributes:
        anchored: Names of parts that stay: the fixed ones, and connectors on plates.
        on_tubes: A connection for every connector on a tube.
        rigid: Pairs of connectors, and of connectors and motors, face to face.
    """

    def __init__(self, parts: Sequence[PartSpec], folder: Path):
        surfaces: dict[str, trimesh.Trimesh] = {}
        self._half: dict[str, Array] = {}
        self._at = {p.name: np.asarray(p.place) for p in parts}
        self._turn = {p.name: rotation_rpy(p.rotation or (0.0, 0.0, 0.0)) for p in parts}
        self._length = {p.name: float(p.options.get("length", 1.0)) for p in parts}
        for p in parts:
            file = str(p.options["file"])
            surfaces.setdefault(file, load_surface(folder / file))
            half = np.abs(surfaces[file].bounds).max(axis=0)
            half = half * np.asarray(p.options.get("scale", (1.0, 1.0, 1.0)))
            self._half[p.name] = half
        by_stem: dict[str, list[str]] = {}
        for p in parts:
            by_stem.setdefault(p.name.partition("_")[0], []).append(p.name)
        connectors = by_stem.get("connector", [])
        self.anchored = {p.name for p in parts if p.anchored}
        self.anchored |= {
            c for c in connectors for plate in by_stem.get("plate", []) if self._lies_on(c, plate)
        }
        self.on_tubes: list[Connection] = []
        for tube, connector in itertools.product(by_stem.get("tube", []), connectors):
            along = self._on_tube(tube, connector)
            if along is not None:
                self.on_tubes.append(
                    Connection(host=f"{tube}.shaft", guest=f"{connector}.bore", at=(along,))
                )
        pairs = [
            *itertools.combinations(connectors, 2),
            *itertools.product(connectors, by_stem.get("rotor", [])),
        ]
        self.rigid = [
            (a, b) for a, b in pairs if not {a, b} <= self.anchored and self._face_to_face(a, b)
        ]
        self._require_held([*by_stem.get("rotor", []), *connectors])

    def _on_tube(self, tube: str, connector: str) -> float | None:
        """Where a connector sits along a tube [m]; None if its bore does not hold the tube."""
        axis = self._turn[tube][:, 0]
        if abs(axis @ self._turn[connector][:, 0]) < 1.0 - 1e-6:
            return None
        offset = self._at[connector] - self._at[tube]
        along = float(offset @ axis)
        aside = float(np.linalg.norm(offset - along * axis))
        return along if aside < _ASIDE and abs(along) <= 0.5 * self._length[tube] else None

    def _reach(self, part: str, axis: Array) -> float:
        """Half the extent of a part's box, turned as the part is, along a direction [m]."""
        return float(np.abs(axis @ self._turn[part]) @ self._half[part])

    def _face_to_face(self, a: str, b: str) -> bool:
        offset = self._at[a] - self._at[b]
        for axis in (*self._turn[a].T, *self._turn[b].T):  # normals of the faces of both
            along = float(offset @ axis)
            aside = float(np.linalg.norm(offset - along * axis))
            reach = self._reach(a, axis) + self._reach(b, axis)
            if aside < _ASIDE and abs(abs(along) - reach) < _GAP:
                return True
        return False

    def _lies_on(self, connector: str, plate: str) -> bool:
        normal = self._turn[plate][:, 2]
        offset = np.abs((self._at[connector] - self._at[plate]) @ self._turn[plate])
        reach = self._reach(connector, normal) + self._half[plate][2]
        inside = offset[:2] <= self._half[plate][:2]
        return bool(inside.all() and abs(offset[2] - reach) < _GAP)

    def _require_held(self, names: Sequence[str]) -> None:
        held = {n for pair in self.rigid for n in pair} | self.anchored
        held |= {c.guest.partition(".")[0] for c in self.on_tubes}
        loose = [n for n in names if n not in held]
        if loose:
            raise MeshError(
                f"{', '.join(loose)} touch{'es' if len(loose) == 1 else ''} no other part; look "
                "for a wrong translation in the XML"
            )
