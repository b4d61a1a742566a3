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
from typing import Any

import yaml

from diffsim.copter._shipped import shipped
from diffsim.copter.design.spec import Connection, DesignSpec, PartSpec
from diffsim.copter.vehicle.parts.database import PART_KINDS, option_names
from diffsim.copter.yaml_lines import Located, read_yaml
from diffsim.copter.yaml_lines import Path as Keys
from diffsim.core.files import to_plain, write_bytes_atomic, write_text_atomic
from diffsim.core.inside import inside, require_file_name

_TOP = ["name", "notes", "parts", "connections", "rigid", "constraints", "values"]
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
    return _spec(read_yaml(text, source), folder)


def write_spec(spec: DesignSpec, path: str | Path) -> Path:
    """Write a specification as YAML, atomically; files of its parts that lie elsewhere come along.

    A design names files of its own folder only, so that who gets it from a stranger need not fear
    what it reads.
    """
    path = Path(path)
    connections = [_without_defaults(c) for c in spec.connections]
    data: dict[str, Any] = {
        "name": spec.name,
        "notes": spec.notes,
        "parts": {p.name: _part_entry(p, spec.folder, path) for p in spec.parts},
        "connections": connections,
        "rigid": [list(pair) for pair in spec.rigid],
        "constraints": list(spec.constraints),
        "values": dict(spec.values),
    }
    kept = {key: value for key, value in data.items() if value}
    return write_text_atomic(path, yaml.safe_dump(to_plain(kept), sort_keys=False, width=100))


def _part_entry(part: PartSpec, folder: Path | None, path: Path) -> dict[str, Any]:
    options = dict(part.options)
    if "file" in options:
        here = (folder or Path()) / options["file"]
        options["file"] = _brought(here.resolve(), path.resolve().parent)
    rest = _without_defaults(part)
    return {"kind": rest.pop("kind"), **options, **{k: rest[k] for k in rest if k in _PART}}


def _brought(file: Path, folder: Path) -> str:
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


def _spec(located: Located, folder: Path | None) -> DesignSpec:
    data = _mapping(located, (), located.value)
    for key in data:
        located.require_choice((key,), "key", key, _TOP)
    parts = _mapping(located, ("parts",), data.get("parts"))
    name = _file_name(located, ("name",), str(data.get("name", Path(located.source).stem)))
    return DesignSpec(
        name=name,
        notes=str(data.get("notes", "")),
        parts=tuple(_part(located, name, value, folder) for name, value in parts.items()),
        connections=tuple(
            _connection(located, ("connections", k), value)
            for k, value in enumerate(_list(located, ("connections",), data.get("connections")))
        ),
        rigid=tuple(
            _pair(located, ("rigid", k), value)
            for k, value in enumerate(_list(located, ("rigid",), data.get("rigid")))
        ),
        constraints=tuple(
            str(text) for text in _list(located, ("constraints",), data.get("constraints"))
        ),
        values={
            name: _number(located, ("values", name), value)
            for name, value in _mapping(located, ("values",), data.get("values", {})).items()
        },
        folder=folder,
    )


def _part(located: Located, name: str, value: Any, folder: Path | None) -> PartSpec:
    at: Keys = ("parts", name)
    _file_name(located, at, name)
    data = _mapping(located, at, value)
    if "kind" not in data:
        raise located.error(at, "kind is missing; say which part of the database this is")
    kind = located.require_choice((*at, "kind"), "kind", str(data["kind"]), PART_KINDS)
    options = {key: v for key, v in data.items() if key not in _PART}
    for key in options:
        known = [*option_names(kind), *sorted(_PART)]
        located.require_choice((*at, key), f"option of a {kind}", key, known)
    if "file" in options:
        _require_inside(located, (*at, "file"), str(options["file"]), folder)
    bounds = _mapping(located, (*at, "bounds"), data.get("bounds", {}))
    fields_of_part: dict[str, Any] = {
        "bounds": {key: _interval(located, (*at, "bounds", key), v) for key, v in bounds.items()},
        "rotation": _numbers(located, (*at, "rotation"), data.get("rotation"), 3),
        "place": _numbers(located, (*at, "place"), data.get("place"), 3),
        "anchored": _flag(located, (*at, "anchored"), data.get("anchored", False)),
        "direction": _numbers(located, (*at, "direction"), data.get("direction"), 3),
        "propeller": _flag(located, (*at, "propeller"), data.get("propeller", True)),
    }
    try:
        return PartSpec(name=name, kind=kind, options=options, **fields_of_part)
    except ValueError as error:
        raise located.error(at, str(error)) from error


def _file_name(located: Located, at: Keys, name: str) -> str:
    try:
        return require_file_name("name", name)
    except ValueError as error:
        raise located.error(at, str(error)) from None


def _require_inside(located: Located, at: Keys, stated: str, folder: Path | None) -> None:
    try:
        inside(folder or Path(), stated, "file")
    except ValueError as error:
        raise located.error(at, str(error)) from None


def _connection(located: Located, at: Keys, value: Any) -> Connection:
    data = _mapping(located, at, value)
    known = [f.name for f in fields(Connection)]
    for key in data:
        located.require_choice((*at, key), "key", key, known)
    for key in ("host", "guest"):
        if key not in data:
            raise located.error(at, f"{key} is missing; write it as part.patch")
    adapters = data.get("adapters")
    slide = data.get("slide")
    return Connection(
        host=str(data["host"]),
        guest=str(data["guest"]),
        at=_numbers(located, (*at, "at"), data.get("at")),
        guest_at=_numbers(located, (*at, "guest_at"), data.get("guest_at")),
        angle=_number(located, (*at, "angle"), data.get("angle", 0.0)),
        roll=_number(located, (*at, "roll"), data.get("roll", 0.0)),
        slide=None if slide is None else _flag(located, (*at, "slide"), slide),
        adapters=None
        if adapters is None
        else tuple(str(v) for v in _list(located, (*at, "adapters"), adapters)),
    )


def _mapping(located: Located, at: Keys, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise located.error(at, f"must map names to values, got {type(value).__name__}")
    return value


def _list(located: Located, at: Keys, value: Any) -> list[Any]:
    if value is None:
        return []
    if not isinstance(value, list):
        raise located.error(at, f"must be a list, got {type(value).__name__}")
    return value


def _pair(located: Located, at: Keys, value: Any) -> tuple[str, str]:
    names = _list(located, at, value)
    if len(names) != 2:
        raise located.error(at, f"must name two parts, got {len(names)}")
    return str(names[0]), str(names[1])


def _number(located: Located, at: Keys, value: Any) -> float:
    return located.require_number(at, value)


def _numbers(
    located: Located, at: Keys, value: Any, count: int | None = None
) -> tuple[float, ...] | None:
    if value is None:
        return None
    items = value if isinstance(value, list) else [value]
    if count is not None and len(items) != count:
        raise located.error(at, f"must hold {count} numbers, got {len(items)}")
    return tuple(_number(located, at, item) for item in items)


def _interval(located: Located, at: Keys, value: Any) -> tuple[float, float]:
    numbers = _list(located, at, value)
    if len(numbers) != 2:
        raise located.error(at, f"must hold 2 numbers, got {len(numbers)}")
    lower, upper = (_number(located, at, v) for v in numbers)
    if not lower <= upper:
        raise located.error(at, f"must be [lower, upper], got [{lower:g}, {upper:g}]")
    return lower, upper


def _flag(located: Located, at: Keys, value: Any) -> bool:
    if not isinstance(value, bool):
        raise located.error(at, f"must be true or false, got {value!r}")
    return value
