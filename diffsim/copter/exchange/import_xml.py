"""Designs of the public tool (mit-gfx/multicopter_design): XML beside OBJ meshes and bench tables.

The XML places every part and says nothing about which touch which; the links are inferred from the
geometry: a connector whose bore holds a tube slides on it; connectors face to face keep their
distance, and so do a motor and the connector under it; a connector on a plate stays. Plates,
battery and electronics stay where they are. Propellers carry no mass there.

A tag or attribute that is not known is an error: one public file once held ``<translat``, which
the tool drops without a word.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from diffsim.copter.design.design import Design, build_design
from diffsim.copter.design.spec import DesignSpec, PartSpec
from diffsim.copter.exchange.xml_links import Links
from diffsim.copter.exchange.xml_nodes import Node, read_nodes
from diffsim.copter.vehicle.geometry import rotation_rpy
from diffsim.core.inside import inside

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
