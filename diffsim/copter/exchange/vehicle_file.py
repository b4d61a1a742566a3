"""Own multicopters without a list of parts: mass, inertia, rotors and battery in a short YAML.

``diffsim.copter.exchange.vehicle_keys`` has the schema. MJCF files that name their rotors as motors
at sites are read as they are (``vehicle_mjcf`` beside it), and SDF files with Gazebo's motor models
(``vehicle_sdf``).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from diffsim.copter.exchange.vehicle_mjcf import body_of, vehicle_of_mjcf, vehicle_of_urdf
from diffsim.copter.exchange.vehicle_sdf import sdf_body, vehicle_of_sdf
from diffsim.copter.vehicle.battery import Battery
from diffsim.copter.vehicle.rotor import RotorModel, rotor_model
from diffsim.copter.vehicle.vehicle_record import (
    DEFAULT_CELLS,
    FRD,
    Body,
    FlyingVehicle,
    assembled,
    own_rotor,
)
from diffsim.core.checked import checked
from diffsim.core.inertia import ENTRIES, inertia_matrix, inertia_mistake
from diffsim.core.inside import inside
from diffsim.core.yaml_text import load_yaml, read_text, read_yaml_file

if TYPE_CHECKING:
    from diffsim.copter.exchange.vehicle_keys import BatteryFacts, RotorFacts, VehicleFile


_TO_FRD = {"FRD": np.eye(3), "FLU": FRD}
_WHOLE = {  # MJCF and SDF say where rotors are, URDF is refused with the way
    ".xml": vehicle_of_mjcf,
    ".sdf": vehicle_of_sdf,
    ".urdf": vehicle_of_urdf,
    ".xacro": vehicle_of_urdf,
}


@checked
def load_vehicle(path: str | Path) -> FlyingVehicle:
    """Read a vehicle file.

    Args:
        path: YAML in the schema of ``diffsim.copter.exchange.vehicle_keys``, MJCF (``.xml``)
            or SDF (``.sdf``).

    Returns:
        The vehicle, its rotors and battery.

    Raises:
        FileNotFoundError: no such file.
        ValueError: what is wrong, by file and key, all mistakes at once.
        ImportError: MuJoCo, which reads MJCF and URDF, is not installed.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no vehicle file {path}")
    if path.suffix in _WHOLE:
        return _WHOLE[path.suffix](path)
    return vehicle_from_text(read_text(path), str(path), path.parent, path.stem)


def is_vehicle_file(path: str | Path) -> bool:
    """Whether a path names a vehicle of numbers, not a design of parts.

    Args:
        path: A file, or the name of a shipped design.
    """
    path = Path(path)
    if path.suffix in _WHOLE:
        return True
    if not path.is_file():
        return False
    content = read_yaml_file(path)
    return isinstance(content, dict) and "parts" not in content


def vehicle_from_text(
    text: str, source: str = "vehicle", folder: Path | None = None, name: str = "multicopter"
) -> FlyingVehicle:
    """Read a vehicle from YAML text.

    Args:
        text: YAML in the schema of ``diffsim.copter.exchange.vehicle_keys``.
        source: What error messages call it.
        folder: Where ``body_file`` lies; None: the current folder.
        name: Of the vehicle, if the text gives none.
    """
    # pydantic takes a third of a second: only for those who read a file
    from diffsim.copter.exchange.vehicle_keys import VehicleFile
    from diffsim.core.schema import read_part

    said = read_part(VehicleFile, load_yaml(text, source), f"{source}: ")
    body = _body(said, folder or Path(), source)
    turn = _TO_FRD[said.body]
    facts = [r.rotor or said.rotor for r in said.rotors]
    cells = DEFAULT_CELLS if said.battery is None else said.battery.cells
    rotors = tuple(_rotor(f, cells) for f in facts if f is not None)
    up = np.array([0.0, 0.0, 1.0 if said.body == "FLU" else -1.0])
    places, axes = [], []
    for k, rotor in enumerate(said.rotors):
        if rotor.body is not None and rotor.body not in body.places:
            raise ValueError(
                f"{source}: rotors[{k}].body: {said.body_file} has no link, body or site "
                f"{rotor.body!r}; it has {', '.join(sorted(body.places))}"
            )
        given = body.places[rotor.body] if rotor.body is not None else rotor.at
        own_axis = body.axes[rotor.body] if rotor.body is not None else up
        axis = np.asarray(own_axis if rotor.axis is None else rotor.axis, dtype=np.float64)
        if not np.linalg.norm(axis) > 0.0:
            raise ValueError(f"{source}: rotors[{k}].axis: must not be zero")
        places.append(np.asarray(given, dtype=np.float64))
        axes.append(axis / np.linalg.norm(axis))
    spins = [1.0 if r.spin == "cw" else -1.0 for r in said.rotors]
    battery = None if said.battery is None else _battery(said.battery)
    return assembled(body, turn, places, axes, spins, rotors, battery, said.name or name, source)


def _rotor(facts: RotorFacts, cells: int) -> RotorModel:
    if facts.model is not None:
        model = rotor_model(facts.model)
        own = facts.time_constant
        return model if own is None else replace(model, time_constant=own)
    return own_rotor(cells=cells, **facts.model_dump(exclude={"model"}))


def _battery(facts: BatteryFacts) -> Battery:
    pack = Battery.lipo(cells=facts.cells, capacity_mah=facts.capacity)
    if facts.resistance is None:
        return pack
    return replace(pack, resistance=torch.tensor(facts.resistance, dtype=torch.float64))


def _body(said: VehicleFile, folder: Path, source: str) -> Body:
    if said.body_file is not None:
        path = inside(folder, said.body_file, f"{source}: body_file")
        return sdf_body(path) if path.suffix == ".sdf" else body_of(path)
    assert said.mass is not None and said.inertia is not None
    entries = (*said.inertia, 0.0, 0.0, 0.0)[:6]
    if mistake := inertia_mistake(entries, [f"inertia[{k}] ({e})" for k, e in enumerate(ENTRIES)]):
        raise ValueError(f"{source}: {mistake}")
    center = np.array(said.center_of_mass or (0.0, 0.0, 0.0), dtype=np.float64)
    return Body(said.mass, inertia_matrix(entries), center, {}, {})
