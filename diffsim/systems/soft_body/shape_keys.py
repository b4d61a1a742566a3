"""Shape of a soft body as a description states it: a bar, a rod, or a file."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from diffsim import mesh as meshes
from diffsim.core.arrays import Array
from diffsim.core.inside import inside
from diffsim.core.schema import FewCells3, Part
from diffsim.core.schema_numbers import Meters, Radians
from diffsim.core.schema_paths import PathInside
from diffsim.core.units import factor
from diffsim.mesh import HexMesh, RegionMesh, TetMesh
from diffsim.systems.soft_body.places import Point, Region

VOLUMES = (".msh", ".vtk", ".vtu", ".inp", ".mesh", ".usd", ".usda", ".usdc")
_UNIT_SPACING = 0.785  # of a rod's section of radius 1: a core of two by two cells and one ring


class Section(Part):
    """Cross-section of a bar at one place."""

    at: Meters = Field(description="Place along x [m]")
    y: tuple[Meters, Meters] = Field(description="From and to across [m]")
    z: tuple[Meters, Meters] = Field(description="From and to up [m]")


class Bar(Part):
    """A bar along x of cuboid cells, straight or with sections that change along it."""

    size: Point | None = Field(None, description="Length, width and height, along x, y, z [m]")
    corner: Point = Field((0.0, 0.0, 0.0), description="Its lowest corner [m]")
    sections: tuple[Section, ...] = Field(
        (), description="Instead of `size`: two sections or more by place, straight between them"
    )
    cells: FewCells3 = Field(
        (10, 2, 2), description="Number of cells along x, y and z; more are slower and more exact"
    )
    floor_layer: Meters | None = Field(
        None,
        description="Thickness of the lowest layer of cells, the same everywhere [m]: tendons act "
        "along the middle of the cells that they pass",
    )

    one_of: ClassVar = ("size", "sections")

    @model_validator(mode="after")
    def _check_one_shape(self) -> Bar:
        if len(self.sections) == 1:
            raise ValueError("sections: two or more, the first and the last are the ends")
        if min(self.cells) < 1:
            raise ValueError(f"cells must be 1 or more along each axis, got {list(self.cells)}")
        return self

    def mesh(self, coarser: float) -> HexMesh:
        """The bar with cells ``coarser`` times as long."""
        nx, ny, nz = (max(1, round(n / coarser)) for n in self.cells)
        grid = meshes.hex_box((nx, ny, nz))
        u = grid.x_rest.numpy()
        at, y, z = self._list_stations()
        x = at[0] + u[:, 0] * (at[-1] - at[0])
        low, high = (np.stack([np.interp(x, at, e[:, i]) for e in (y, z)], 1) for i in (0, 1))
        across = low + u[:, 1:] * (high - low)
        if self.floor_layer is not None and nz > 1:
            layer = np.rint(u[:, 2] * nz)
            top, floor = high[:, 1], low[:, 1] + self.floor_layer
            above = floor + (layer - 1) / (nz - 1) * (top - floor)
            across[:, 1] = np.where(layer == 0, low[:, 1], above)
        points = torch.from_numpy(np.column_stack([x, across]))
        return HexMesh(points, grid.hexes)

    def _list_stations(self) -> tuple[Array, Array, Array]:
        if self.size is not None:
            low, size = np.array(self.corner), np.array(self.size)
            ends = np.stack([low, low + size], 1)
            return ends[0], np.stack([ends[1]] * 2), np.stack([ends[2]] * 2)
        ordered = sorted(self.sections, key=lambda s: s.at)
        return (
            np.array([s.at for s in ordered]),
            np.array([s.y for s in ordered]),
            np.array([s.z for s in ordered]),
        )


class Station(Part):
    """Radius of a rod at one place."""

    at: Meters = Field(description="Place along x [m]")
    radius: Meters = Field(gt=0, description="Radius there [m]")


class Rod(Part):
    """A rod along x with a round section, its axis on y = z = 0."""

    stations: tuple[Station, ...] = Field(
        min_length=2, description="Radius at two places or more, straight between them"
    )
    cells: int = Field(
        20, ge=1, le=50_000, description="Number of cells along; twelve fill a section"
    )

    def mesh(self, coarser: float) -> HexMesh:
        """The rod with cells ``coarser`` times as long."""
        along = max(1, round(self.cells / coarser))
        spacing = _UNIT_SPACING if coarser >= 1.0 else _UNIT_SPACING * coarser
        rod = meshes.hex_cylinder(1.0, along * spacing, spacing)
        at = np.array([s.at for s in self.stations])
        radii = np.array([s.radius for s in self.stations])
        order = np.argsort(at)
        u = rod.x_rest.numpy()
        x = at.min() + (u[:, 2] / (along * spacing) + 0.5) * np.ptp(at)
        radius = np.interp(x, at[order], radii[order])
        points = np.column_stack([x, u[:, 0] * radius, u[:, 1] * radius])
        return HexMesh(torch.from_numpy(points), rod.hexes)


class MeshFile(Part):
    """A body from a file: a mesh of cells, or a closed surface that is filled with cells."""

    path: PathInside = Field(description="File, relative to the study: .msh, .vtk, .stl, .obj, ...")
    unit: str = Field("m", description="Unit of its coordinates")
    spacing: Meters | None = Field(
        None, gt=0, description="Length of the cells that fill a surface [m]"
    )
    cells: Literal["cubes", "tetrahedra"] = Field("cubes", description="What fills a surface")
    keep: Region | None = Field(None, description="Keep only the cells there, half of a body, say")
    groups: str | None = Field(
        None,
        description="Cell data of the file that tell its regions of material, or `sets`, its named "
        "groups; default: physical groups, element sets, GeomSubsets, or the only whole numbers",
    )

    def mesh(self, coarser: float, folder: Path | None) -> HexMesh | TetMesh:
        """The body, a filled surface with cells ``coarser`` times as long."""
        path, scale = self._find_file(folder)
        if self.is_volume:
            return self._keep_elements(meshes.load(path, scale))
        if self.spacing is None:
            raise ValueError(f"{self.path} is a surface; give the length of the cells, spacing")
        surface, spacing = meshes.load_surface(path, scale), self.spacing * coarser
        fill = meshes.voxelize if self.cells == "cubes" else meshes.tetrahedralize
        return self._keep_elements(fill(surface, spacing))

    def regions(self, folder: Path | None) -> RegionMesh:
        """The file's regions of material, of the cells that are kept.

        Raises:
            ValueError: a surface has none; the file has none, or several kinds.
        """
        if not self.is_volume:
            raise ValueError(
                f"{self.path} is a surface, which has no regions of material; give where, or a "
                f"mesh of cells ({', '.join(VOLUMES)})"
            )
        path, scale = self._find_file(folder)
        found = meshes.load_regions(path, scale, key=self.groups)
        if self.keep is None:
            return found
        cells = self.keep.elements(found.mesh)
        data = {name: values[cells] for name, values in found.element_data.items()}
        return RegionMesh(self._keep_elements(found.mesh), found.names, found.region[cells], data)

    @property
    def is_volume(self) -> bool:
        """Whether the file holds cells, not a surface."""
        return Path(self.path).suffix.lower() in VOLUMES

    def _find_file(self, folder: Path | None) -> tuple[Path, float]:
        """The file, and meters per unit of its coordinates."""
        return inside(folder or Path(), self.path, "model: path"), factor(self.unit, "m")

    def _keep_elements(self, made: HexMesh | TetMesh) -> HexMesh | TetMesh:
        if self.keep is None:
            return made
        chosen = made.elements[self.keep.elements(made)]
        used, local = torch.unique(chosen, return_inverse=True)
        return type(made)(made.x_rest[used], local)


class BodyShape(Part):
    """Shape and placement of the body at rest."""

    bar: Bar | None = Field(None, description="A bar along x")
    rod: Rod | None = Field(None, description="A rod along x with a round section")
    file: MeshFile | None = Field(None, description="A mesh or a surface from a file")
    rotation: tuple[Radians, Radians, Radians] = Field(
        (0.0, 0.0, 0.0), description="Rotation vector that turns it about the origin [rad]"
    )
    shift: Point = Field((0.0, 0.0, 0.0), description="Moved by, after the rotation [m]")

    one_of: ClassVar = ("bar", "rod", "file")

    @property
    def can_refine(self) -> bool:
        """Whether meshes of any cell size can be made."""
        return self.file is None or not self.file.is_volume

    def groups(self, folder: Path | None) -> RegionMesh:
        """Regions of material that the body's mesh file names.

        Raises:
            ValueError: the body is not from a mesh file of cells, or the file has no regions.
        """
        if self.file is None:
            raise ValueError("only a body from a mesh file has groups; give where instead")
        return self.file.regions(folder)

    def mesh(self, coarser: float, folder: Path | None) -> HexMesh | TetMesh:
        """The body where it is at rest, cells ``coarser`` times as long as stated."""
        made: HexMesh | TetMesh
        if self.bar is not None:
            made = self.bar.mesh(coarser)
        elif self.rod is not None:
            made = self.rod.mesh(coarser)
        else:
            assert self.file is not None
            made = self.file.mesh(coarser, folder)
        if not any(self.rotation) and not any(self.shift):
            return made
        turned = Rotation.from_rotvec(self.rotation).apply(made.x_rest.numpy())
        return type(made)(torch.from_numpy(turned + np.array(self.shift)), made.elements)
