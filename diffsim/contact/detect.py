"""Which obstacle each point meets in a step, as one half space per point."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.contact.obstacle import Obstacle, require_obstacles
from diffsim.contact.sweep import first_entry, first_entry_in_graph
from diffsim.core.check import require, require_number
from diffsim.core.checked import checked
from diffsim.core.numbers import anywhere
from diffsim.core.values import dot


class ContactPlanes(NamedTuple):
    """Half spaces normal . (x - reference) >= offset for positions x at the end of a step.

    Attributes:
        normal: Outward unit normals of the obstacles at their end poses, (..., c, 3).
        reference: Where the points would be if they stuck to their obstacle's material: x_start
            plus its displacement over the step, (..., c, 3) [m]. x - reference is slip.
        offset: Offset of the half space along the normal, (..., c) [m].
        friction: Coulomb coefficient, (..., c) [-], may be inf.
        restitution: Newton's coefficient, (..., c) [-].
        obstacle: Index of the obstacle, (..., c) int64.
        distance: Signed distance at x_start and the start pose, (..., c) [m].
    """

    normal: Tensor
    reference: Tensor
    offset: Tensor
    friction: Tensor
    restitution: Tensor
    obstacle: Tensor
    distance: Tensor


@checked
def detect(
    obstacles: Sequence[Obstacle] | Obstacle,
    x_start: Tensor,
    x_end: Tensor,
    dt: float,
    *,
    max_depenetration_speed: float = math.inf,
    continuous: bool = True,
) -> ContactPlanes:
    """Linearized contact of points that move from x_start to about x_end in one step.

    For each point the obstacle of least signed distance at x_end and the end pose, linearized at
    x_end: phi(x_end) + n . (x - x_end) >= 0. Where the straight path, seen from the moving
    obstacle, enters an obstacle and ends on another side of it (normals 90 degrees or more apart,
    or in by 30 degrees or steeper and out again), the first such obstacle is linearized at the
    entry instead, so that fast points do not tunnel through thin obstacles. (For a turning obstacle
    the path is the chord in its frame.)

    Restitution e > 0 raises the offset to -e v_n dt for a point that approaches (v_n < 0, relative,
    over the step) and would be inside at x_end: Newton's impact law on the step's displacement.

    One half space per point: a point in a corner between two obstacles gets the deeper one; call
    again with the corrected x_end for the other.

    Args:
        obstacles: Obstacles at their poses at the start of the step.
        x_start: Positions at the start of the step, (..., c, 3) [m].
        x_end: Candidate end positions, same shape [m].
        dt: Time step [s].
        max_depenetration_speed: Points that start inside are pushed out no faster [m/s].
        continuous: Whether the path counts; False looks at its end alone.

    Returns:
        :class:`ContactPlanes`. Gradients: x_start, x_end, the obstacles' poses, velocities, shape
        parameters and coefficients; first order. Which obstacle, and which of entry and end, is
        piecewise constant.
    """
    many = require_obstacles(obstacles)
    start = require("x_start", x_start, ("...", "c", 3))
    end = require("x_end", x_end, tuple(start.shape))
    dt = require_number("dt", dt, above=0.0, hint="unit is s")
    if not (isinstance(max_depenetration_speed, (int, float)) and max_depenetration_speed >= 0):
        raise ValueError(
            f"max_depenetration_speed must be >= 0 m/s, got {max_depenetration_speed!r}; "
            "math.inf lifts the limit"
        )
    shape = start.shape[:-1]
    step = _Step(
        many,
        [obstacle.after(dt) for obstacle in many],
        dt,
        start.reshape(-1, 3),
        end.reshape(-1, 3),
        _members(many, shape),
        max_depenetration_speed * dt,
        continuous,
    )
    if len(many) == 1:
        paths = step.paths(0)
        planes = _planes(step, 0, paths, step.entry(0, paths))
    elif torch.compiler.is_compiling() and all(one.shape.in_one_graph for one in many):
        planes = _stacked_planes(step)
    else:
        planes = _nearest_planes(step)
    return ContactPlanes(*(field.reshape(*shape, *field.shape[1:]) for field in planes))


class _Paths(NamedTuple):
    """Points before and after a step in an obstacle's frame, and how deep."""

    y0: Tensor
    y1: Tensor
    phi0: Tensor
    phi1: Tensor
    normal1: Tensor


class _Step(NamedTuple):
    """Points that move, the members they belong to, and obstacles before and after."""

    many: list[Obstacle]
    moved: list[Obstacle]
    dt: float
    start: Tensor
    end: Tensor
    member: Tensor
    push: float
    continuous: bool

    def paths(self, index: int) -> _Paths:
        """All points as one obstacle sees them."""
        shape = self.many[index].shape
        y0, y1 = self.many[index].to_local(self.start), self.moved[index].to_local(self.end)
        return _Paths(y0, y1, shape.evaluate(y0)[0], *shape.evaluate(y1))

    def entry(self, index: int, paths: _Paths) -> Tensor | None:
        """Where in [0, 1] each path enters an obstacle (inf: not used); None: no path does."""
        shape = self.many[index].shape
        if not (self.continuous and shape.can_tunnel):
            return None
        given = [t.detach() for t in paths]
        if torch.compiler.is_compiling() and shape.in_one_graph:
            return first_entry_in_graph(*given, handle=shape.handle)
        entry = first_entry(shape, *given)
        return entry if bool(entry.isfinite().any()) else None

    def of(self, own: Tensor) -> _Step:
        """The step of some points."""
        return self._replace(start=self.start[own], end=self.end[own], member=self.member[own])


def _choice(depths: list[Tensor], entries: list[Tensor | None]) -> tuple[Tensor, Tensor]:
    """Where each path first enters (inf: nowhere), and the obstacle that counts for it."""
    none = torch.full_like(depths[0], math.inf)
    entry, first = torch.stack([none if one is None else one for one in entries]).min(0)
    return entry, torch.where(entry.isfinite(), first, torch.stack(depths).argmin(0))


def _nearest_planes(step: _Step) -> ContactPlanes:
    """The half space of each point's obstacle."""
    with torch.no_grad():
        every = [step.paths(k) for k in range(len(step.many))]
        entries = [step.entry(k, paths) for k, paths in enumerate(every)]
        entry, choice = _choice([paths.phi1 for paths in every], entries)
    parts: list[ContactPlanes] = []
    order: list[Tensor] = []
    for k in range(len(step.many)):
        own = torch.nonzero(choice == k).flatten()
        if not len(own) and (parts or k + 1 < len(step.many)):
            continue
        order.append(own)
        part = step.of(own)
        used = entry[own] if bool(entry[own].isfinite().any()) else None
        parts.append(_planes(part, k, part.paths(k), used))
    back = torch.argsort(torch.cat(order))
    return ContactPlanes(*(torch.cat(fields)[back] for fields in zip(*parts, strict=True)))


def _stacked_planes(step: _Step) -> ContactPlanes:
    """The same in one graph: what a number decides is evaluated either way."""
    every = [step.paths(k) for k in range(len(step.many))]
    entries = [step.entry(k, paths) for k, paths in enumerate(every)]
    parts = [_planes(step, k, every[k], entries[k]) for k in range(len(step.many))]
    _, choice = _choice([paths.phi1.detach() for paths in every], entries)

    def chosen(*fields: Tensor) -> Tensor:
        stacked = torch.stack(fields)
        at = choice.reshape(1, -1, *[1] * (stacked.ndim - 2)).expand(1, *stacked.shape[1:])
        return stacked.gather(0, at)[0]

    return ContactPlanes(*(chosen(*fields) for fields in zip(*parts, strict=True)))


def _planes(step: _Step, index: int, paths: _Paths, entry: Tensor | None) -> ContactPlanes:
    """Half spaces of points that meet one obstacle; ``index`` is its place in the list."""
    obstacle, later = step.many[index], step.moved[index]
    start, end = step.start, step.end
    y0, y1, distance, phi, normal = paths
    at = end
    if entry is not None:
        entered = entry.isfinite()
        path = y1 - y0
        t = torch.where(entered, entry, 1.0)
        phi_t, normal_t = obstacle.shape.evaluate(y0 + t[:, None] * path)
        # one Newton step with the slope held: exact derivative of the entry's place
        sharp = entered & (distance.detach() >= 0)
        rate = torch.where(sharp, dot(normal_t, path).detach(), -1.0)
        t = torch.where(sharp, t - phi_t / rate, t)
        q = torch.where(entered[:, None], y0 + t[:, None] * path, y1)
        phi, normal = obstacle.shape.evaluate(q)
        at = torch.where(entered[:, None], later.to_world(q), end)
    normal = normal @ later.rotation.T
    reference = start + obstacle.displacement(start, step.dt) if obstacle.moves else start
    offset = dot(normal, at - reference) - phi
    if math.isfinite(step.push):
        offset = torch.where(distance.detach() < 0, offset.clamp(max=step.push), offset)
    friction, restitution = (
        value.expand_as(phi) if value.ndim == 0 else value[step.member]
        for value in (obstacle.friction, obstacle.restitution)
    )
    bounces = torch.compiler.is_compiling() or restitution.requires_grad  # one graph has both
    if bounces or anywhere(restitution > 0):
        approach = dot(normal, end - reference)
        bounce = -restitution * approach
        inside = phi.detach() < 0
        hits = (inside if entry is None else inside | entered) & (approach.detach() < 0)
        hits = hits & (bounce.detach() > 0)
        offset = torch.where(hits, torch.maximum(offset, bounce), offset)
    return ContactPlanes(
        normal=normal,
        reference=reference,
        offset=offset,
        friction=friction,
        restitution=restitution,
        obstacle=torch.full(phi.shape, index, dtype=torch.int64),
        distance=distance,
    )


def _members(obstacles: Sequence[Obstacle], shape: torch.Size) -> Tensor:
    """The member of a batch that each point belongs to, (points,); shape is (..., c)."""
    for obstacle in obstacles:
        require_members("friction", obstacle.friction, shape[:-1])
        require_members("restitution", obstacle.restitution, shape[:-1])
    return torch.arange(math.prod(shape)) // max(shape[-1], 1)


def require_members(name: str, value: Tensor, batch: Sequence[int]) -> None:
    """Refuse a coefficient (n,) of members unless the points have the batch axis (n,)."""
    if value.ndim and tuple(value.shape) != tuple(batch):
        raise ValueError(
            f"{name} of an obstacle is given for {value.shape[0]} members, and the state has batch "
            f"axes {tuple(batch)}; they must agree"
        )
