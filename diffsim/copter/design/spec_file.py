"""Specifications of designs as YAML files.

Schema (lengths in meters, angles in degrees, frame NED: up is -z)::

    name: quadcopter
    notes: where the numbers come from            # optional
    parts:                                        # in the order in which they join
      plate_1:
        kind: plate                               # in diffsim.copter.vehicle.parts.PART_KINDS
        length: 0.15                              # options of the kind: start of a parameter,
        thickness: 0.0024                         #   or a constant size
        bounds: {length: [0.1, 0.3]}              # optional, of parameters
        rotation: [0, 0, 90]                      # optional roll, pitch, yaw: R = Rz Ry Rx
        place: [0, 0, -0.1]                       # optional start of the origin
        anchored: true                            # optional; default: the first part
      motor_1: {kind: motor, rotor: kde2814_10in, spin: cw, direction: [0.1, 0, -1]}
                                                  # direction: optional, of the thrust
                                                  # propeller: false leaves the propeller off
    connections:
      - {host: plate_1.top, guest: rod_1.shaft, at: [0.05, 0], angle: 90}
                                                  # optional: guest_at, roll, slide, adapters;
                                                  # see diffsim.copter.design.spec.Connection
    rigid: [[connector_1, motor_1]]               # optional: keep the distance vector
    constraints: ["rod_1.length == rod_2.length"] # optional, linear, ==, <= or >=
    values: {rod_1.length: 0.6}                   # optional, wins over the parts' own

Numbers of ``values`` are the free parameters when a design is saved, so that it loads as it was.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from diffsim.copter._shipped import shipped
from diffsim.copter.design.spec import Connection, DesignSpec, PartSpec
from diffsim.core.errors import Mistakes
from diffsim.core.files import to_plain, write_bytes_atomic, write_text_atomic
from diffsim.core.inside import inside, require_file_name
from diffsim.core.yaml_text import load_yaml

if TYPE_CHECKING:
    from diffsim.copter.design.spec_keys import PartKeys

_PART = {"kind", "bounds", "rotation", "place", "anchored", "direction", "propeller"}


def shipped_designs() -> tuple[str, ...]:
    """Names of the designs that come with the package."""
    return shipped("design/designs")


def spec_from_text(text: str, source: str = "design", folder: Path | None = None) -> DesignSpec:
    """Read a specification from YAML text.

    Args:
        text: See the schema above.
        source: What error messages call it.
        folder: Folder of the files that the text names.
    """
    # pydantic takes a third of a second: only for those who read a file
    from diffsim.copter.design.spec_keys import DesignKeys
    from diffsim.core.schema import read_part

    said = read_part(DesignKeys, load_yaml(text, source), f"{source}: ")
    return DesignSpec(
        name=said.name or Path(source).stem,
        notes=said.notes,
        parts=_parts(said.parts, source, folder),
        connections=tuple(Connection(**dict(c)) for c in said.connections or ()),
        rigid=said.rigid or (),
        constraints=said.constraints or (),
        values=said.values,
        folder=folder,
    )


def write_spec(spec: DesignSpec, path: str | Path) -> Path:
    """Write a specification as YAML, atomically; files of its parts that lie elsewhere come along.

    A design names files of its own folder only, so that who gets it from a stranger need not fear
    what it reads.

    Raises:
        ValueError: what could not be read again, such as NaN; nothing is written then.
    """
    path = Path(path)
    data = _data_of(spec)
    spec_from_text(_yaml_of(data), f"design {spec.name!r}", spec.folder)
    for part in spec.parts:
        if "file" in part.options:
            here = (spec.folder or Path()) / part.options["file"]
            brought = _bring_file(here.resolve(), path.resolve().parent)
            data["parts"][part.name]["file"] = brought
    return write_text_atomic(path, _yaml_of(data))


def _yaml_of(data: Mapping[str, Any]) -> str:
    text: str = yaml.safe_dump(to_plain(data, keep_nan=True), sort_keys=False, width=100)
    return text


def _data_of(spec: DesignSpec) -> dict[str, Any]:
    """What a file says; files of parts by name alone."""
    data: dict[str, Any] = {
        "name": spec.name,
        "notes": spec.notes,
        "parts": {p.name: _part_entry(p) for p in spec.parts},
        "connections": [_without_defaults(c) for c in spec.connections],
        "rigid": list(spec.rigid),
        "constraints": list(spec.constraints),
        "values": dict(spec.values),
    }
    return {key: value for key, value in data.items() if value}


def _part_entry(part: PartSpec) -> dict[str, Any]:
    options = dict(part.options)
    if "file" in options:
        if not isinstance(options["file"], (str, Path)):
            raise TypeError(f"file of part {part.name} must be a path, got {options['file']!r}")
        options["file"] = Path(options["file"]).name
    rest = _without_defaults(part)
    return {"kind": rest.pop("kind"), **options, **{k: rest[k] for k in rest if k in _PART}}


def _bring_file(file: Path, folder: Path) -> str:
    """Path of a file from a folder; one that is not in it is copied there."""
    if file.is_relative_to(folder):
        return file.relative_to(folder).as_posix()
    content = file.read_bytes()
    name = file.name
    if (folder / name).exists() and (folder / name).read_bytes() != content:
        name = f"{file.stem}_{hashlib.sha256(content).hexdigest()[:8]}{file.suffix}"
    write_bytes_atomic(folder / name, content)
    return name


def _without_defaults(item: Any) -> dict[str, Any]:
    """Fields of a frozen dataclass that say something; empty adapters do: join directly."""
    values = {f.name: getattr(item, f.name) for f in fields(item)}
    defaults = {f.name: f.default for f in fields(item)}
    return {
        key: value
        for key, value in values.items()
        if value != defaults[key] and (value != {} or key == "adapters")
    }


def _parts(parts: Mapping[str, PartKeys], source: str, folder: Path | None) -> tuple[PartSpec, ...]:
    made, lines = [], []
    for name, keys in parts.items():
        try:
            made.append(_part(name, keys, folder))
        except ValueError as error:
            lines.append(f"{source}: parts.{name}: {error}")
    if lines:
        raise Mistakes(lines)
    return tuple(made)


def _part(name: str, keys: PartKeys, folder: Path | None) -> PartSpec:
    common = {key: value for key, value in keys if key in _PART}
    own = keys.model_fields_set - _PART
    options = {key: value for key, value in keys if key in own}
    if "file" in options:
        inside(folder or Path(), str(options["file"]), "file")
    return PartSpec(name=require_file_name("name", name), options=options, **common)
