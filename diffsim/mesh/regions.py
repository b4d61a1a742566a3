"""Meshes with regions of material: named groups of elements, and values of each as a tensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import IntArray
from diffsim.core.check import did_you_mean, require, require_choice
from diffsim.core.checked import checked
from diffsim.core.errors import MeshError
from diffsim.core.numbers import values_of
from diffsim.mesh.core import HexMesh, TetMesh
from diffsim.mesh.files import mesh_of, read_volume
from diffsim.mesh.volume_files import VolumeFile

SETS = "sets"
"""Key of the named groups of elements, beside the names of cell data."""

_PHYSICAL = "gmsh:physical"
_Labels = tuple[tuple[str, ...], IntArray]  # names; position in them, -1: in none


@checked
@dataclass(frozen=True, eq=False)
class RegionMesh:
    """A mesh whose elements belong to named regions.

    Attributes:
        mesh: The mesh; its elements are in the file's order.
        names: Names of the regions.
        region: Position in ``names`` for each element, (num_elements,) int64; -1: in none.
        element_data: What else the file says per element, (num_elements, ...) each.
    """

    mesh: HexMesh | TetMesh
    names: tuple[str, ...]
    region: Tensor
    element_data: Mapping[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        region = require("region", self.region, (len(self.mesh.elements),), torch.int64)
        if region.numel() and not -1 <= int(region.min()) <= int(region.max()) < len(self.names):
            raise ValueError(f"region must hold indices of names in [-1, {len(self.names)})")
        object.__setattr__(self, "region", region)

    @checked
    def elements(self, name: str) -> Tensor:
        """Indices of a region's elements, ascending, (num_selected,) int64.

        Raises:
            ValueError: no such region; the message offers the closest names.
        """
        require_choice("name of a region", name, self.names)
        return torch.nonzero(self.region == self.names.index(name)).flatten()

    @checked
    def values(self, of: Mapping[str, float | Tensor], default: float | None = None) -> Tensor:
        """One value per element, by region: what ``SoftBody`` takes as ``youngs_modulus``.

        Args:
            of: Value of each region by its name: a number, or a () tensor, which gets its gradient.
            default: Value of elements and regions that are not named; None: all must be named.

        Returns:
            (num_elements,) float64. Gradients: tensors of ``of``.

        Raises:
            ValueError: an unknown name, or elements without a value.
        """
        for name in of:
            if name not in self.names:
                raise ValueError(
                    f"the mesh has no region {name!r}{did_you_mean(name, self.names)}; it has "
                    f"{', '.join(self.names)}"
                )
        missing = [name for name in self.names if name not in of]
        loose = int((values_of(self.region) < 0).sum())
        if default is None and (missing or loose):
            what = [f"regions {', '.join(missing)}"] if missing else []
            what += [f"{loose} elements that are in no region"] if loose else []
            raise ValueError(f"no value for {' and '.join(what)}; name them, or give default=")
        rest = torch.tensor(0.0 if default is None else float(default), dtype=torch.float64)
        table = [_scalar(name, of[name]) if name in of else rest for name in self.names]
        return torch.stack([*table, rest])[self.region]  # -1 is the last: the default


@checked
def load_regions(path: str | Path, scale: float = 1.0, key: str | None = None) -> RegionMesh:
    """Read a volume mesh and its regions of material.

    Args:
        path: A file that ``diffsim.mesh.load`` reads.
        scale: Meters per unit of the file, 1e-3 for millimeters.
        key: Cell data of whole numbers that tell the regions, or "sets": named groups; None:
            physical groups of GMSH, element sets of Abaqus, GeomSubsets of USD, or the only cell
            data of whole numbers.

    Returns:
        The mesh with its regions. Numbers without a name are called by themselves, such as "2".

    Raises:
        FileNotFoundError: no such file.
        ValueError: unknown extension, no such key, no regions, or several candidates.
        MeshError: what ``diffsim.mesh.load`` refuses; an element in two regions.
    """
    path = Path(path)
    content = read_volume(path, scale)
    names, index = _choose_labels(path, content, key)
    mesh = mesh_of(path, torch.from_numpy(content.x), torch.from_numpy(content.elements))
    return RegionMesh(
        mesh,
        names,
        torch.from_numpy(index),
        {name: torch.from_numpy(_to_library_types(v)) for name, v in content.element_data.items()},
    )


def _choose_labels(path: Path, content: VolumeFile, key: str | None) -> _Labels:
    data = content.element_data
    known = [*([SETS] if content.groups else []), *data]
    if key is not None:
        require_choice(f"key (of {path.name})", key, known)
        return _of_sets(path, content) if key == SETS else _of_data(path, content, key)
    if content.groups:
        labels = _of_sets(path, content)  # refuses elements in two groups
        return _of_data(path, content, _PHYSICAL) if _PHYSICAL in data else labels
    whole = [k for k, v in data.items() if v.ndim == 1 and np.issubdtype(v.dtype, np.integer)]
    if _PHYSICAL in whole:
        return _of_data(path, content, _PHYSICAL)
    if not whole:
        has = f"; it has cell data {', '.join(known)}: name one with key=" if known else ""
        raise ValueError(f"{path} holds no regions of material (groups or whole numbers){has}")
    if len(whole) > 1:
        raise ValueError(
            f"{path} holds several cell data of whole numbers: {', '.join(whole)}; say which "
            f"tells the regions, such as key={whole[0]!r}"
        )
    return _of_data(path, content, whole[0])


def _of_data(path: Path, content: VolumeFile, key: str) -> _Labels:
    """Labels of one whole number per element; a number without a name is called by itself."""
    values = content.element_data[key]
    if values.ndim != 1 or not np.array_equal(values, np.round(values)):
        raise ValueError(
            f"{path}: cell data {key!r} must be one whole number per element; values that differ "
            f"within a region are parameters themselves: load_regions(...).element_data[{key!r}]"
        )
    present, index = np.unique(values, return_inverse=True)
    names = content.tag_names if key == _PHYSICAL else {}
    shown = tuple(names.get(int(v), str(int(v))) for v in present)
    return shown, index.reshape(-1).astype(np.int64)


def _of_sets(path: Path, content: VolumeFile) -> _Labels:
    """Labels of named groups.

    Raises:
        MeshError: an element is in two of them.
    """
    names = list(content.groups)
    index = np.full(len(content.elements), -1, np.int64)
    for k, members in enumerate(content.groups.values()):
        taken = members[index[members] >= 0]
        if len(taken):
            raise MeshError(
                f"{path}: {len(taken)} elements, the first {int(taken[0])}, are in two groups, "
                f"{names[index[taken[0]]]!r} and {names[k]!r}; a region has one material: take "
                "them out of one group, or name cell data with key=",
                tuple(int(i) for i in taken[:10]),
            )
        index[members] = k
    return tuple(names), index


def _to_library_types(values: Any) -> np.ndarray:
    """As int64 or float64, the library's types."""
    whole = np.issubdtype(values.dtype, np.integer)
    return np.ascontiguousarray(values, np.int64 if whole else np.float64)


def _scalar(name: str, value: float | Tensor) -> Tensor:
    if isinstance(value, Tensor):
        return require(f"value of region {name!r}", value, ())
    return torch.tensor(float(value), dtype=torch.float64)
