"""Muscle fibers: elements that contract along a direction on command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.core.check import (
    require,
    require_choice,
    require_constant,
    require_entries,
    require_indices,
    require_number,
    require_range,
)
from diffsim.core.numbers import anywhere, values_of
from diffsim.core.values import as_array

KINDS = ("length", "contraction", "tendon")


@dataclass(frozen=True, eq=False, kw_only=True)
class Muscle:
    """Fibers through some elements, driven by one activation.

    * ``kind="length"``: psi = w/2 (|F m| - a)^2, activation a = target stretch; 1 is rest, below 1
      contracts (Min et al. 2019; the published DiffPD code).
    * ``kind="contraction"``: psi = w/2 |(1 - r) F m|^2, activation r in [0, 1] (thesis 4.1.6): the
      fiber always pulls, least at r = 1.
    * ``kind="tendon"``: psi = w/2 max(0, |F m| - a)^2, activation a = commanded length over rest
      length: pulls when longer than commanded, is slack when shorter, and never pushes. Slack, it
      has no force and no gradient; just taut (within 1e-12), the derivatives of the taut side.

    Attributes:
        elements: Element indices, (num_fibers,) int64.
        direction: Fiber direction m in the rest shape, (3,) or (num_fibers, 3); normalized here.
        stiffness: w [Pa], > 0.
        kind: What the activation means: ``length``, ``contraction`` or ``tendon``.
        weights: Factor on ``stiffness`` of each fiber, (num_fibers,) > 0; None: ones. With weights
            in 1/m^2 the stiffness is a force, see :class:`~diffsim.soft.Tendon`.
        is_cable: Whether ``weights`` are the length of each fiber over its element's volume: they
            then follow a rest shape that ``body.physics(x_rest=...)`` gives. False: they stay.
    """

    elements: Tensor
    direction: Tensor | Sequence[float]
    stiffness: float
    kind: str = "length"
    weights: Tensor | None = None
    is_cable: bool = False

    def __post_init__(self) -> None:
        elements = require(
            "elements",
            as_array("elements", self.elements, torch.int64),
            ("num_fibers",),
            torch.int64,
        )
        if elements.numel() == 0:
            raise ValueError("elements must name at least one element, got none")
        for name in ("direction", "weights", "stiffness"):
            hint = "Physics carries fiber_stiffness" if name == "stiffness" else ""
            require_constant(name, getattr(self, name), hint)
        direction = as_array("direction", self.direction, torch.float64)
        if direction.ndim == 1:
            direction = direction.expand(elements.numel(), -1)
        direction = require("direction", direction, (elements.numel(), 3))
        norm = direction.norm(dim=1, keepdim=True)
        if anywhere(norm == 0):
            raise ValueError("direction must not be zero")
        require_number("stiffness", self.stiffness, above=0.0, hint="unit is Pa")
        require_choice("kind", self.kind, KINDS)
        weights = torch.ones(elements.numel(), dtype=torch.float64)
        if self.weights is not None:
            weights = require("weights", self.weights, (elements.numel(),))
            require_range("weights", weights, above=0.0)
        object.__setattr__(self, "weights", values_of(weights))
        object.__setattr__(self, "elements", values_of(elements))
        object.__setattr__(self, "direction", values_of((direction / norm).contiguous()))

    @property
    def rest_activation(self) -> float:
        """The activation without force at rest, or with the least (``contraction``)."""
        return 1.0


class FiberValues(NamedTuple):
    """What the fibers of one step have."""

    stiffness: Tensor  # stiffness of each fiber, (num_fibers,) [Pa]
    stretch: Tensor  # target stretch, (..., num_fibers) [-]


class MuscleSet:
    """All muscles of a body, as the flat fiber arrays that kernels read."""

    def __init__(self, muscles: Sequence[Muscle], num_elements: int):
        if not isinstance(muscles, Sequence):
            raise TypeError(f"muscles must be a list of Muscle, got {type(muscles).__name__}")
        require_entries("muscles", muscles, Muscle)
        for k, muscle in enumerate(muscles):
            require_indices(f"muscles[{k}].elements", muscle.elements, num_elements, "elements")
        self.num_muscles = len(muscles)
        empty = torch.zeros(0, dtype=torch.int64)
        self.elements = torch.cat([empty, *(m.elements for m in muscles)])
        self.directions = torch.cat(
            [
                torch.zeros(0, 3, dtype=torch.float64),
                *(torch.as_tensor(m.direction) for m in muscles),
            ]
        )
        self.owner = torch.cat(
            [empty, *(torch.full_like(m.elements, k) for k, m in enumerate(muscles))]
        )
        self.weights = torch.cat(
            [torch.zeros(0, dtype=torch.float64), *(torch.as_tensor(m.weights) for m in muscles)]
        )
        self.stiffness = torch.tensor([float(m.stiffness) for m in muscles], dtype=torch.float64)
        self.contraction = torch.tensor([m.kind == "contraction" for m in muscles])
        # Per fiber, 1 where it cannot push; part of the prepared model, as directions are.
        self.pull_only = torch.tensor([m.kind == "tendon" for m in muscles], dtype=torch.float64)[
            self.owner
        ]
        self.is_cable = torch.tensor([bool(m.is_cable) for m in muscles])[self.owner]
        self.has_cables = any(m.is_cable for m in muscles)
        self.has_contraction = any(m.kind == "contraction" for m in muscles)
        self.rest_activation = torch.tensor(
            [m.rest_activation for m in muscles], dtype=torch.float64
        )

    def fibers(
        self, stiffness: Tensor, activation: Tensor, weights: Tensor | None = None
    ) -> FiberValues:
        """Stiffness and target stretch of the fibers; weights as for :meth:`of_fibers`.

        A contraction muscle is the length muscle of stiffness w (1 - r)^2 and target 0; its
        stiffness would differ within a batch, so such muscles take one activation for all of it.
        """
        if not self.num_muscles:
            return FiberValues(stiffness=stiffness, stretch=activation)
        if self.has_contraction:
            per_member = stiffness.ndim == 2  # (batch, num_muscles), as activation then is
            shared = activation if per_member else _shared_activation(activation, self.contraction)
            slack = torch.where(self.contraction, (1.0 - shared) ** 2, torch.ones_like(stiffness))
            stiffness = stiffness * slack
            activation = torch.where(self.contraction, torch.zeros_like(activation), activation)
        return FiberValues(
            stiffness=self.of_fibers(stiffness, weights), stretch=self.stretch_of_fibers(activation)
        )

    def stretch_of_fibers(self, activation: Tensor) -> Tensor:
        """Target stretch of each fiber, (..., num_fibers), where no muscle is a contraction [-]."""
        return activation[..., self.owner] if self.num_muscles else activation

    def of_fibers(self, stiffness: Tensor, weights: Tensor | None = None) -> Tensor:
        """Stiffness of each fiber, (..., num_fibers), from that of the muscles [Pa].

        Args:
            stiffness: Of the muscles, (..., num_muscles) [Pa].
            weights: In place of the fibers' own, (..., num_fibers); None: those.
        """
        if not self.num_muscles:
            return stiffness
        return stiffness[..., self.owner] * (self.weights if weights is None else weights)


def _shared_activation(activation: Tensor, which: Tensor) -> Tensor:
    """The one row (num_muscles,) of a batch of activations that agree on the muscles ``which``."""
    rows = activation.reshape(-1, activation.shape[-1])
    leading = zip(activation.shape[:-1], activation.stride()[:-1], strict=True)
    if all(size == 1 or stride == 0 for size, stride in leading):
        return rows[0]  # one row, expanded
    if torch.compiler.is_compiling() or bool((rows[:1] != rows)[:, which].any()):
        raise ValueError(
            "activation of contraction muscles must be the same for the whole batch; pass one of "
            "shape (num_muscles,), or step such states one at a time"
        )
    # All entries are equal: the maximum is their value, and its gradient is shared out evenly.
    return rows.amax(0)
