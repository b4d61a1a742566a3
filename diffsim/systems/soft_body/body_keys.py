"""All keys of ``model: {system: soft_body}``."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from diffsim import mesh as meshes
from diffsim.causes.channel_groups import CLOCKS, clock_of
from diffsim.core.arrays import Array
from diffsim.core.check import did_you_mean
from diffsim.core.inside import inside
from diffsim.core.schema import FewCells3, Part
from diffsim.core.schema_numbers import Meters, Radians
from diffsim.core.schema_paths import PathInside
from diffsim.core.units import factor
from diffsim.mesh import HexMesh, RegionMesh, TetMesh
from diffsim.systems.description import Description, Quantity, quantities_of
from diffsim.systems.quantities import Time
from diffsim.systems.soft_body.keys import (
    Chamber,
    Clamp,
    DescribedMuscle,
    DescribedTendon,
    Drive,
    Gravity,
    Load,
    Material,
    MaterialRegion,
    Numerics,
    Start,
    Stop,
    Support,
    Vibration,
    Wall,
    Water,
)
from diffsim.systems.soft_body.places import Point, Region
from diffsim.systems.soft_body.readings import Camera, Clock, MarkerPlace, Reading

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


class SoftBodyKeys(Description):
    """A body of soft material with what holds, pulls, loads and surrounds it."""

    system: Literal["soft_body"] = Field(description="Kind of system")
    body: BodyShape = Field(description="Shape of the body at rest, and where it is")
    material: Material = Field(description="Material of the body")
    regions: tuple[MaterialRegion, ...] = Field((), description="Parts of another material")
    fixed: tuple[Clamp, ...] = Field((), description="Clamps and planes of symmetry")
    gravity: Gravity = Field(Gravity(), description="Gravity; down along z by default")
    masses: tuple[Load, ...] = Field((), description="Masses that are attached, weights that hang")
    tendons: tuple[DescribedTendon, ...] = Field((), description="Cables that pull")
    muscles: tuple[DescribedMuscle, ...] = Field((), description="Parts that contract")
    chambers: tuple[Chamber, ...] = Field((), description="Cavities under pressure")
    water: Water | None = Field(None, description="A fluid around the body")
    walls: tuple[Wall, ...] = Field((), description="Flat obstacles")
    stops: tuple[Stop, ...] = Field(
        (), max_length=1, description="A stop that may be in the way: cause one_sided_stop"
    )
    sliding: Region | None = Field(
        None, description="Nodes that rub, on a rail say: dry friction acts there; default: all"
    )
    support: Support | None = Field(
        None, description="Recorded motion of what holds the body: cause support_motion"
    )
    vibration: Vibration | None = Field(
        None, description="A base that may shake unrecorded: cause base_vibration"
    )
    slack_string: Meters | None = Field(
        None,
        description="Attached masses may hang slack at first and be caught after a fall of about "
        "this height [m]: cause slack_string",
    )
    markers: dict[str, MarkerPlace] = Field(description="Points that are watched, by name")
    channels: dict[str, Reading] = Field(description="What each channel of the study shows")
    camera: Camera = Field(Camera(), description="What all channels share")
    clock: Clock = Field(Clock(), description="Clock of the recording against that of the commands")
    clocks: dict[str, Time] = Field({}, description=CLOCKS)
    start: Start = Field(Start(), description="How the body begins")
    numerics: Numerics = Field(Numerics(), description="Time step, mesh and tolerance")

    @model_validator(mode="after")
    def _check_markers_exist(self) -> SoftBodyKeys:
        for name, reading in self.channels.items():
            for marker in (*reading.markers, *reading.minus):
                if marker not in self.markers:
                    raise ValueError(
                        f"channels.{name}: no marker {marker!r}"
                        f"{did_you_mean(marker, self.markers)}; known: {', '.join(self.markers)}"
                    )
        return self

    @property
    def commands(self) -> tuple[str, ...]:
        """Names of the commands that drive something."""
        drives = (*self.tendons, *self.muscles, *self.chambers)
        return tuple(dict.fromkeys(d.command for d in drives))

    def quantities(self) -> dict[str, Quantity]:
        """All imperfectly known numbers, by name of their base parameter."""
        found = quantities_of(self.material) | quantities_of(self.gravity, "gravity_")
        for region in self.regions:
            own = quantities_of(region)
            found |= {f"{key}_{region.name}": q for key, q in own.items()}
        named: tuple[Load | Drive, ...] = (
            *self.masses, *self.tendons, *self.muscles, *self.chambers
        )  # fmt: skip
        for part in named:
            found |= quantities_of(part, f"{part.name}_")
        if self.water is not None:
            found |= quantities_of(self.water, "water_")
        found |= quantities_of(self.start, "start_") | quantities_of(self.clock, "clock_")
        found |= quantities_of(self.camera, "camera_")
        found |= {clock_of(name): q for name, q in self.clocks.items()}
        for name, reading in self.channels.items():
            found |= {f"{key}_{name}": q for key, q in quantities_of(reading).items()}
        return found
