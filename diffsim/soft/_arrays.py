"""The tensors that the kernels of a soft body read: one record for each concept.

Records are made by keyword and read by name, so that two tensors of one shape cannot change places.
Custom ops take lists: :meth:`Arrays.tensors` and :meth:`Arrays.of` alone turn names into an order
and back. The names are those of csrc/bindings/soft_arrays.h.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, dataclass, field
from typing import ClassVar, NamedTuple, TypeVar

import torch
from torch import Tensor


class Spec(NamedTuple):
    """What holds for one tensor of a record.

    Attributes:
        shape: Sizes without the batch axis; names stand for those of the body.
        batched: Whether a batch axis leads; all else is shared by the items of a batch, or given
            for each of them (:attr:`Arrays.per_member`).
        differentiable: Whether an adjoint returns its gradient.
        damping: Whether it is empty in a body without stiffness-proportional damping.
    """

    shape: tuple[str | int, ...]
    batched: bool = True
    differentiable: bool = True
    damping: bool = False


_Record = TypeVar("_Record", bound="Arrays")


def _spec(*shape: str | int, **properties: bool) -> dict[str, Spec]:
    return {"spec": Spec(shape, **properties)}


@dataclass(frozen=True, kw_only=True, eq=False)
class Arrays:
    """A record of float64 tensors.

    Attributes:
        specs: What holds for each tensor by name, in the order of the ops' lists.
    """

    specs: ClassVar[Mapping[str, Spec]] = {}

    def __init_subclass__(cls) -> None:
        own = {n: f.metadata["spec"] for n, f in vars(cls).items() if isinstance(f, Field)}
        cls.specs = {**cls.specs, **own}

    @classmethod
    def differentiable(cls) -> list[str]:
        """Names of the tensors whose gradients an adjoint returns, in its order."""
        return [name for name, spec in cls.specs.items() if spec.differentiable]

    @property
    def per_member(self) -> bool:
        """Whether what is shared otherwise has a batch axis as well."""
        return False

    def has_batch(self, name: str) -> bool:
        """Whether a batch axis leads a tensor."""
        return self.specs[name].batched or self.per_member

    @classmethod
    def of(cls: type[_Record], tensors: Sequence[Tensor]) -> _Record:
        """The record of an op's list."""
        return cls(**dict(zip(cls.specs, tensors, strict=True)))

    @classmethod
    def all_gradients(cls, grads: Sequence[Tensor]) -> list[Tensor | None]:
        """One entry for each tensor of the list; None where an adjoint has no gradient."""
        named = dict(zip(cls.differentiable(), grads, strict=True))
        return [named.get(name) for name in cls.specs]

    def tensors(self) -> list[Tensor]:
        """The list that an op takes."""
        return list(self.named().values())

    def named(self) -> dict[str, Tensor]:
        """The tensors by name."""
        return {name: getattr(self, name) for name in self.specs}

    def shared(self) -> dict[str, Tensor]:
        """What the items of a batch share, by name; the mean where it is given for each of them."""
        found = {n: t for n, t in self.named().items() if not self.specs[n].batched}
        return {n: _mean(t) if self.has_batch(n) else t for n, t in found.items()}

    def item(self, k: int) -> dict[str, Tensor]:
        """Item k of the batch by name, with the shared tensors."""
        named = self.named()
        return {n: t[k] if self.has_batch(n) and t.numel() else t for n, t in named.items()}

    @classmethod
    def directions(cls, tangents: Sequence[Tensor | None], like: Tensor) -> list[Tensor]:
        """Tangents as ops take them: an empty tensor for what does not move."""
        still = like.new_empty(0)
        return [still if t is None or not t.numel() else t for t in tangents]

    def moving(self, directions: Sequence[Tensor]) -> dict[str, Tensor]:
        """The directions of an op's list that move, by name, as kernels read them."""
        named = dict(zip(self.specs, directions, strict=True))
        moved = {n: named[n].contiguous() for n in self.differentiable() if named[n].numel()}
        for name, direction in moved.items():
            require_array(f"direction of {name}", direction, tuple(getattr(self, name).shape))
        return moved

    def item_of(self, moved: Mapping[str, Tensor], k: int) -> dict[str, Tensor]:
        """Item k of the batch of some directions; shared ones as they are."""
        return {n: t[k] if self.has_batch(n) else t for n, t in moved.items()}

    def require_sizes(self, batch: int, sizes: Mapping[str, int], *, damped: bool = True) -> None:
        """Refuse any other size than that of a body: kernels read whole arrays.

        Args:
            batch: Number of items.
            sizes: Of the body, by the names that shapes use.
            damped: Whether the tensors of damping are given.
        """
        self.require_shapes(self.shapes(batch, sizes, damped=damped))

    def shapes(
        self, batch: int, sizes: Mapping[str, int], *, damped: bool = True
    ) -> dict[str, tuple[int, ...]]:
        """What :meth:`require_sizes` requires, by name."""
        found = {}
        for name, spec in self.specs.items():
            own = tuple(sizes[size] if isinstance(size, str) else size for size in spec.shape)
            shape = (batch, *own) if self.has_batch(name) else own
            found[name] = (0,) if spec.damping and not damped else shape
        return found

    def require_shapes(self, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Refuse other shapes of some tensors, by name."""
        for name, shape in shapes.items():
            require_array(name, getattr(self, name), shape)

    def gradient_buffers(self, batch: int) -> dict[str, Tensor]:
        """Zeroed outputs of an adjoint; those of shared tensors get a batch axis as well."""
        named = self.named()
        return {
            n: named[n].new_zeros(named[n].shape if self.has_batch(n) else (batch, *named[n].shape))
            for n in self.differentiable()
        }

    def summed(self, grads: Mapping[str, Tensor]) -> list[Tensor]:
        """Buffers as the op returns them: those of shared tensors summed over the batch."""
        return [g if self.has_batch(name) else _sum(g) for name, g in grads.items()]

    def empty_gradients(self) -> list[Tensor]:
        """What an adjoint returns, without its values."""
        named = self.named()
        return [torch.empty_like(named[name]) for name in self.differentiable()]


@dataclass(frozen=True, kw_only=True, eq=False)
class EnergyArrays(Arrays):
    """Parameters of the elastic, damping and pressure energies.

    Attributes:
        weights: Of the solid, (num_weights, num_elements) [Pa], see
            :mod:`diffsim.soft.materials`. These, ``fiber_stiffness``, ``damp_mu`` and
            ``damp_lambda`` may all lead with a batch axis.
        fiber_stiffness: Stiffness of each fiber, (num_fibers,) [Pa].
        activation: Target stretch of each fiber, (batch, num_fibers) [-].
        damp_mu, damp_lambda: Weights of damping, (num_elements,) [Pa].
        x_frame: Positions of the frame that damping refers to, (batch, num_nodes, 3) [m].
        x_velocity: Positions that velocity is measured from, (batch, num_nodes, 3) [m].
        pressure: Gauge pressures, (batch, num_chambers) [Pa].
    """

    weights: Tensor = field(metadata=_spec("num_weights", "num_elements", batched=False))
    fiber_stiffness: Tensor = field(metadata=_spec("num_fibers", batched=False))
    activation: Tensor = field(metadata=_spec("num_fibers"))
    damp_mu: Tensor = field(metadata=_spec("num_elements", batched=False, damping=True))
    damp_lambda: Tensor = field(metadata=_spec("num_elements", batched=False, damping=True))
    x_frame: Tensor = field(metadata=_spec("num_nodes", 3, damping=True))
    x_velocity: Tensor = field(metadata=_spec("num_nodes", 3, damping=True))
    pressure: Tensor = field(metadata=_spec("num_chambers"))

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
    """The problem of one implicit step, see csrc/kernels/soft/implicit_step.h.

    Attributes:
        y: Inertial positions, (batch, num_nodes, 3) [m].
        force: Force on each node, (batch, num_nodes, 3) [N].
        target: Positions of Dirichlet nodes, (batch, num_nodes, 3) [m].
        guess: Start of the iteration, (batch, num_nodes, 3) [m]; its gradient is zero but in
            linearly implicit steps.
        inertia: Mass over the squared time step of each node, (num_nodes,) [N/m].
    """

    y: Tensor = field(metadata=_spec("num_nodes", 3))
    force: Tensor = field(metadata=_spec("num_nodes", 3))
    target: Tensor = field(metadata=_spec("num_nodes", 3))
    guess: Tensor = field(metadata=_spec("num_nodes", 3))
    inertia: Tensor = field(metadata=_spec("num_nodes", batched=False))


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactArrays(Arrays):
    """Half spaces of the nodes that may touch, see :class:`diffsim.contact.ContactPlanes`.

    Attributes:
        normal: Normal of each contact, (batch, num_contacts, 3) [-].
        reference: Place that sticking holds each node at, (batch, num_contacts, 3) [m].
        offset: Least normal displacement of each contact, (batch, num_contacts) [m].
        friction: Friction coefficient of each contact, (batch, num_contacts) [-].
        force_guess: Contact forces to start from, (batch, num_contacts, 3) [N]; no gradient.
    """

    normal: Tensor = field(metadata=_spec("num_contacts", 3))
    reference: Tensor = field(metadata=_spec("num_contacts", 3))
    offset: Tensor = field(metadata=_spec("num_contacts"))
    friction: Tensor = field(metadata=_spec("num_contacts"))
    force_guess: Tensor = field(metadata=_spec("num_contacts", 3, differentiable=False))


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
