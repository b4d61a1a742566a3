"""Which parts of a public-tool design touch: the XML only places them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from diffsim.copter.design.spec import Connection, PartSpec
from diffsim.copter.vehicle.geometry import rotation_rpy
from diffsim.core.arrays import Array
from diffsim.core.errors import MeshError
from diffsim.mesh.files import load_surface

if TYPE_CHECKING:
    import trimesh


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
