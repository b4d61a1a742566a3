"""Torch tensors of a composed design: from all parameters to masses and rotors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from diffsim.copter.design.placement import PlacedPart
from diffsim.copter.vehicle.mass import Moments, mesh_moments, placed_moments
from diffsim.core.arrays import Array


class PartTensors:
    """What is constant while parameters move; gradients flow through every method."""

    def __init__(self, placed: Sequence[PlacedPart], names: Sequence[str]):
        index = {name: i for i, name in enumerate(names)}
        self._position_idx = torch.tensor([[index[n] for n in p.position_names] for p in placed])
        self._rotations = torch.from_numpy(np.stack([p.rotation for p in placed]))
        self._densities = _tensor([p.part.density for p in placed])
        moving = [k for k, p in enumerate(placed) if p.part.parameters]
        self._moving = _Meshes([placed[k] for k in moving], moving, index)
        still = [k for k, p in enumerate(placed) if not p.part.parameters]
        self._still = self._local(
            _Meshes([placed[k] for k in still], still, index),
            torch.zeros(len(names), dtype=torch.float64),
        )
        self._rotor_parts = [k for k, p in enumerate(placed) if p.part.rotor_mount is not None]
        self._price = _tensor([p.part.price for p in placed])
        self._price_per_mass = _tensor([p.part.price_per_mass for p in placed])
        self._price_row = torch.zeros(len(names), dtype=torch.float64)
        self._rod_row = torch.zeros(len(names), dtype=torch.float64)
        for p in placed:
            for name, price in zip(p.shape_names, p.part.price_per_parameter, strict=False):
                self._price_row[index[name]] = price
            if p.part.rod_parameter is not None:
                self._rod_row[index[p.shape_names[p.part.rod_parameter]]] = 1.0

    def moments(self, x: Tensor) -> Moments:
        """Moments of all parts in the design's frame."""
        moving = self._local(self._moving, x)
        local = Moments(*(a + b for a, b in zip(moving, self._still, strict=True)))
        return placed_moments(local, self._rotations, x[self._position_idx])

    def rotor_positions(self, x: Tensor) -> Tensor:
        """Centers of the propellers in the design's frame, (n_rotors, 3) [m]."""
        return x[self._position_idx[self._rotor_parts]]

    def cost(self, x: Tensor, mass: Tensor) -> Tensor:
        """Price of all parts of these masses, () [EUR]."""
        return self._price.sum() + self._price_row @ x + self._price_per_mass @ mass

    def rod_length(self, x: Tensor) -> Tensor:
        """Total length of the rods, () [m]."""
        return self._rod_row @ x

    def _local(self, meshes: _Meshes, x: Tensor) -> Moments:
        return mesh_moments(meshes.vertices(x), meshes.faces, meshes.part_of_face, self._densities)


class _Meshes:
    """Several parts' meshes as one, each in its part's frame."""

    def __init__(
        self, placed: Sequence[PlacedPart], part_idx: Sequence[int], index: dict[str, int]
    ):
        shape_names = [name for p in placed for name in p.shape_names]
        self._shape_idx = torch.tensor([index[n] for n in shape_names], dtype=torch.int64)
        counts = [len(p.part.mesh.vertices.offset) for p in placed]
        first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        basis = np.zeros((int(first[-1]), 3, len(shape_names)))
        column = 0
        for p, start, stop in zip(placed, first[:-1], first[1:], strict=True):
            width = len(p.shape_names)
            basis[start:stop, :, column : column + width] = p.part.mesh.vertices.basis
            column += width
        offsets = [p.part.mesh.vertices.offset for p in placed]
        faces = [p.part.mesh.faces + start for p, start in zip(placed, first[:-1], strict=True)]
        owners = [np.full(len(p.part.mesh.faces), k) for p, k in zip(placed, part_idx, strict=True)]
        self._offset = _tensor(np.concatenate([np.zeros((0, 3)), *offsets]))
        self._basis = _tensor(basis)
        self.faces = torch.from_numpy(np.concatenate([np.zeros((0, 3), np.int64), *faces]))
        self.part_of_face = torch.from_numpy(np.concatenate([np.zeros(0, np.int64), *owners]))

    def vertices(self, x: Tensor) -> Tensor:
        return self._offset + self._basis @ x[self._shape_idx]


def _tensor(values: Sequence[float] | Array) -> Tensor:
    return torch.as_tensor(np.asarray(values, dtype=np.float64))
