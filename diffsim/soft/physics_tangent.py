"""Derivatives of a body's parameters along many directions: physics with a leading K."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from diffsim.core.checked import checked
from diffsim.core.numbers import require_unmapped
from diffsim.core.torch_names import is_in_forward_mode
from diffsim.soft.physics import Physics
from diffsim.soft.solid import Solid


@checked
def physics_directions(
    body: Solid, values: Mapping[str, Tensor], directions: Mapping[str, Tensor]
) -> Physics:
    """Derivatives of ``body.physics(**values)`` along K directions.

    Args:
        body: The body.
        values: Overrides by name, as ``body.physics`` takes them.
        directions: K directions of some of ``values``, by name: (K, *shape of the value), in the
            value's unit per unit of a direction.

    Returns:
        Physics whose tensors have a leading K.
    """
    if is_in_forward_mode():
        raise NotImplementedError("physics_directions is forward mode itself: a derivative in one")
    require_unmapped(**values, **{f"directions of {n}": d for n, d in directions.items()})
    if unknown := set(directions) - set(values):
        raise ValueError(f"directions of {sorted(unknown)} have no value; give values of the same")
    (count,) = {d.shape[0] for d in directions.values()}
    rows = []
    for k in range(count):
        with forward_ad.dual_level():
            dual = {
                n: forward_ad.make_dual(v, directions[n][k]) if n in directions else v
                for n, v in values.items()
            }
            rows.append(_unpack_tangents(body.physics(**dual)))
    return stack_physics(rows)


def stack_physics(rows: list[Physics]) -> Physics:
    """K physics as one whose tensors have a leading K; damping where any has it."""
    damped = next((r.rayleigh_beta for r in rows if r.rayleigh_beta is not None), None)
    if damped is not None:
        none = torch.zeros_like(damped)
        rows = [r if r.rayleigh_beta is not None else replace(r, rayleigh_beta=none) for r in rows]
    stacked = {n: torch.stack([getattr(r, n) for r in rows]) for n in _tensors(rows[0])}
    return _replace_tensors(rows[0], stacked)


def difference_physics(points: Sequence[Physics], weights: Sequence[float]) -> Physics:
    """Sum of weight times physics at the points of a difference formula: one direction."""
    stacked = stack_physics(list(points))
    weight = torch.tensor(weights, dtype=torch.float64)
    return _replace_tensors(
        stacked, {n: torch.tensordot(weight, v, 1) for n, v in _tensors(stacked).items()}
    )


def _unpack_tangents(physics: Physics) -> Physics:
    """The tangents of dual numbers."""

    def tangent(value: Tensor) -> Tensor:
        primal, tangent = forward_ad.unpack_dual(value)
        return torch.zeros_like(primal) if tangent is None else tangent

    return _replace_tensors(physics, {n: tangent(v) for n, v in _tensors(physics).items()})


def still_physics(physics: Physics, count: int) -> Physics:
    """Directions in which no parameter moves."""
    return _replace_tensors(
        physics, {n: v.new_zeros(count, *v.shape) for n, v in _tensors(physics).items()}
    )


def as_damped_as(changing: Physics, physics: Physics) -> Physics:
    """Undamped bodies whose damping moves need its terms, with zeros."""
    if changing.rayleigh_beta is None or physics.rayleigh_beta is not None:
        return physics
    return replace(physics, rayleigh_beta=torch.zeros_like(physics.weights[..., 0, :]))


def _tensors(physics: Physics) -> dict[str, Tensor]:
    values = {f.name: getattr(physics, f.name) for f in fields(Physics)}
    return {n: v for n, v in values.items() if isinstance(v, Tensor)}


def _replace_tensors(physics: Physics, tensors: Mapping[str, Any]) -> Physics:
    return replace(physics, **tensors)
