"""The tensors that the kernels of a soft body read: one record for each concept.

Records are made by keyword and read by name, so that two tensors of one shape cannot change places.
Ops take them in the order of :attr:`Arrays.specs`. The names are those of
csrc/bindings/soft_arrays.h.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor

from diffsim.core.ops import Array, Call, array, resolve

NODAL = ("batch", "num_nodes", 3)
CONTACTS = ("batch", "num_contacts")

_Record = TypeVar("_Record", bound="Arrays")


def _spec(*shape: str | int, **properties: Any) -> dict[str, Array]:
    return {"spec": array(*shape, **properties)}


@dataclass(frozen=True, kw_only=True, eq=False)
class Arrays:
    """A record of float64 tensors."""

    # what holds for each tensor by name, in the order of the ops' arguments. "batch" leads what
    # differs between the items of a batch; all else is shared, "...", or given for each of them
    # (:attr:`per_member`).
    specs: ClassVar[Mapping[str, Array]] = {}

    def __init_subclass__(cls) -> None:
        own = {n: f.metadata["spec"] for n, f in vars(cls).items() if isinstance(f, Field)}
        cls.specs = {**cls.specs, **own}

    @classmethod
    def of(cls: type[_Record], tensors: Mapping[str, Tensor]) -> _Record:
        """The record of tensors by name, of which there may be more."""
        return cls(**{name: tensors[name] for name in cls.specs})

    @classmethod
    def is_batched(cls, name: str) -> bool:
        """Whether a tensor always differs between the items of a batch."""
        return cls.specs[name].shape[0] == "batch"

    @property
    def per_member(self) -> bool:
        """Whether what is shared otherwise has a batch axis as well."""
        return False

    def has_batch(self, name: str) -> bool:
        """Whether a batch axis leads a tensor."""
        return self.is_batched(name) or self.per_member

    def tensors(self) -> list[Tensor]:
        """The tensors as an op takes them."""
        return list(self.named().values())

    def named(self) -> dict[str, Tensor]:
        """The tensors by name."""
        return {name: getattr(self, name) for name in self.specs}

    def shared(self) -> dict[str, Tensor]:
        """What the items of a batch share, by name; the mean where it is given for each of them."""
        found = {n: t for n, t in self.named().items() if not self.is_batched(n)}
        return {n: _mean(t) if self.has_batch(n) else t for n, t in found.items()}

    def item(self, k: int) -> dict[str, Tensor]:
        """Item k of the batch by name, with the shared tensors."""
        return self.item_of(self.named(), k)

    def item_of(self, tensors: Mapping[str, Tensor], k: int) -> dict[str, Tensor]:
        """Item k of the batch of tensors by these names; shared and absent ones as they are."""
        return {n: t[k] if self.has_batch(n) and t.numel() else t for n, t in tensors.items()}

    def shapes(self, batch: int, sizes: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
        """Shapes by name in a batch of so many, with the sizes of a body."""
        lead = (batch,) if self.per_member else ()
        known = {**sizes, "batch": batch, "...": lead}
        return {
            name: (0,)
            if isinstance(spec.optional, str) and not getattr(self, spec.optional).numel()
            else resolve(spec, known)
            for name, spec in self.specs.items()
        }

    def require_shapes(self, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Refuse other shapes of some tensors, by name: kernels read whole arrays."""
        for name, shape in shapes.items():
            require_array(name, getattr(self, name), shape)

    def gradients(self, call: Call) -> dict[str, Tensor]:
        """Memory for an adjoint by name: items of a batch have their own gradients of what they
        share, which :meth:`add_gradients` adds up."""
        batch = call.sizes["batch"]
        for name, spec in self.specs.items():
            if spec.smooth and not self.has_batch(name):
                call[f"grad_{name}"] = call[name].new_zeros(batch, *call[name].shape)
        return {n: call[f"grad_{n}"] for n, spec in self.specs.items() if spec.smooth}

    def add_gradients(self, call: Call) -> None:
        """Gradients of a call as its op returns them."""
        for name, spec in self.specs.items():
            if spec.smooth and not self.has_batch(name):
                call[f"grad_{name}"] = _sum(call[f"grad_{name}"])

    def moved(self, call: Call) -> dict[str, Tensor]:
        """Directions of a call by name; absent ones do not move."""
        found = {n: call[f"d_{n}"] for n, spec in self.specs.items() if spec.smooth}
        return {name: direction for name, direction in found.items() if direction.numel()}


@dataclass(frozen=True, kw_only=True, eq=False)
class EnergyArrays(Arrays):
    """Parameters of the elastic, damping and pressure energies."""

    # of the solid, (num_weights, num_elements) [Pa], see :mod:`diffsim.soft.materials`. These,
    # ``fiber_stiffness``, ``damp_mu`` and ``damp_lambda`` may all lead with a batch axis.
    weights: Tensor = field(metadata=_spec("...", "num_weights", "num_elements"))
    # stiffness of each fiber, (num_fibers,) [Pa]
    fiber_stiffness: Tensor = field(metadata=_spec("...", "num_fibers"))
    # target stretch of each fiber, (batch, num_fibers) [-]
    activation: Tensor = field(metadata=_spec("batch", "num_fibers"))
    # damp_mu, damp_lambda: weights of damping, (num_elements,) [Pa]
    damp_mu: Tensor = field(metadata=_spec("...", "num_elements", optional="damp_mu"))
    damp_lambda: Tensor = field(metadata=_spec("...", "num_elements", optional="damp_mu"))
    # positions of the frame that damping refers to, (batch, num_nodes, 3) [m]
    x_frame: Tensor = field(metadata=_spec(*NODAL, optional="damp_mu"))
    # positions that velocity is measured from, (batch, num_nodes, 3) [m]
    x_velocity: Tensor = field(metadata=_spec(*NODAL, optional="damp_mu"))
    # gauge pressures, (batch, num_chambers) [Pa]
    pressure: Tensor = field(metadata=_spec("batch", "num_chambers"))
    # what the kernels know of the rest shape, (num_tables,), see :mod:`diffsim.soft.rest_shape`;
    # empty: that of the mesh
    tables: Tensor = field(metadata=_spec("num_tables", optional="tables"))

    @property
    def per_member(self) -> bool:
        """Whether parameters (and inertia) have a batch axis."""
        return self.weights.ndim == 3

    @property
    def damped(self) -> bool:
        """Whether there is stiffness-proportional damping."""
        return self.damp_mu.numel() > 0


@dataclass(frozen=True, kw_only=True, eq=False)
class StepArrays(EnergyArrays):
    """The problem of one implicit step, see csrc/kernels/soft/implicit_step.h."""

    y: Tensor = field(metadata=_spec(*NODAL))  # inertial positions, (batch, num_nodes, 3) [m]
    force: Tensor = field(metadata=_spec(*NODAL))  # force on each node, (batch, num_nodes, 3) [N]
    # positions of Dirichlet nodes, (batch, num_nodes, 3) [m]
    target: Tensor = field(metadata=_spec(*NODAL))
    # start of the iteration, (batch, num_nodes, 3) [m]; its gradient is zero but in linearly
    # implicit steps
    guess: Tensor = field(metadata=_spec(*NODAL))
    # mass over the squared time step of each node, (num_nodes,) [N/m]
    inertia: Tensor = field(metadata=_spec("...", "num_nodes"))


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactArrays(Arrays):
    """Half spaces of the nodes that may touch, see :class:`diffsim.contact.ContactPlanes`."""

    # normal of each contact, (batch, num_contacts, 3) [-]
    normal: Tensor = field(metadata=_spec(*CONTACTS, 3))
    # place that sticking holds each node at, (batch, num_contacts, 3) [m]
    reference: Tensor = field(metadata=_spec(*CONTACTS, 3))
    # least normal displacement of each contact, (batch, num_contacts) [m]
    offset: Tensor = field(metadata=_spec(*CONTACTS))
    # friction coefficient of each contact, (batch, num_contacts) [-]
    friction: Tensor = field(metadata=_spec(*CONTACTS))
    # contact forces to start from, (batch, num_contacts, 3) [N]; no gradient
    force_guess: Tensor = field(metadata=_spec(*CONTACTS, 3, smooth=False))


def require_array(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    """Refuse a tensor that a kernel could not read as (shape) doubles in a row."""
    if tensor.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
    if tensor.dtype != torch.float64 or not tensor.is_contiguous():
        raise TypeError(f"{name} must be contiguous float64")


def _mean(tensor: Tensor) -> Tensor:
    if not tensor.numel():
        return tensor.new_empty(tensor.shape[-1:])
    return _reduce_rows(tensor, lambda row: row.mean(0))


def _sum(buffer: Tensor) -> Tensor:
    return buffer[0].clone() if len(buffer) == 1 else _reduce_rows(buffer, lambda row: row.sum(0))


def _reduce_rows(tensor: Tensor, reduce: Callable[[Tensor], Tensor]) -> Tensor:
    """(batch, size) reduced to (size,), and (batch, rows, size) row by row: the order in which
    torch adds depends on the size, so rows of one tensor are summed as tensors of their own."""
    if tensor.ndim == 2:
        return reduce(tensor)
    return torch.stack([reduce(row) for row in tensor.unbind(1)])
