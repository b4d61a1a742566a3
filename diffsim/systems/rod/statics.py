"""Equilibrium of a slender rod that is pulled by tendons and its own weight.

A geometrically exact (Cosserat) rod: sections stay plane, and strains of the axis (twist, two
bendings, stretch, two shears) may turn it by any angle. Unknown is the bending strain u of each
element; rotations follow by products of exp(h u), places by sums (midpoint rule, second order).

At a section, body and tendons together carry the loads beyond it. With the unit tangent t of a
tendon at r, of tension T, the body is left with

    n = n_beyond - sum T t,    m = m_beyond - sum r x (T t),

so that a tendon's pull along its path and its pull at its end need no terms of their own (the same
balance as Rucker and Webster, IEEE T-RO 2011, eq. 15 and 16, integrated once). The residual is
K (u - u0) + sum r x (T t) - R' m_beyond, in the frame of the section.

Rubber that is pressed together by the share 1 - y keeps its volume: a section widens by y^-1/2, and
so do the levers of the tendons. Its fibers follow P = E (y - y^-2) / 3 (incompressible neo-Hookean,
Treloar, The Physics of Rubber Elasticity, 1975, 4.3), so that the stiffness against bends becomes
P'(y) I / y, and against twist G J / y. ``rubber`` is the share of all this that acts.

All of it is compiled, derivatives too: ``csrc/kernels/rod``. Newton's method finds each equilibrium
by itself, from its guess or, where that fails, from no tension by growing shares of it. A rod that
hangs and is lifted past the point where it turns over has no such way: it comes to rest instead, as
a body without inertia does, from unloaded; stable equilibria alone are found so.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffsim.core.errors import ConvergenceError
from diffsim.systems.rod import _ops
from diffsim.systems.rod.layout import RodPoints, RodShape

# of the way that rods come to rest: chosen on two hanging ones of 24 elements with 84 poses, lifted
# by up to 2 pi, of which 31 have no way from no tension
REST_SHARE = 0.2  # of a step
REST_STEPS = 400
REST_TURN = 0.01  # of all elements together, from where Newton's method goes on [rad]
OVERSHOT = 1.05  # times the turn before


class Survey(NamedTuple):
    """What else is known of rods, in equilibrium or not; no gradients."""

    frames: Tensor  # (K, S, N + 1, 3, 3) rotations of the sections at the edges
    nodes: Tensor  # (K, S, N + 1, 3) their places [m]
    stretches: Tensor  # (K, S, N, 3) stretch and shears of the elements, 1 0 0 at rest [-]
    tensions: Tensor  # (K, S, N, T) of the tendons at the middles of the elements [N]
    residual: Tensor  # (K, S, N, 3) moment that is left over in the sections [N m]


@dataclass(frozen=True, eq=False)
class RodStatics:
    """All numbers of rods; the leading axes (...) are at most two, K points and S poses, each whole
    or one.
    """

    shape: RodShape  # elements
    bending: Tensor  # (..., N, 3) stiffness against twist and two bendings [N m^2]
    stretch: Tensor  # (..., N, 3) stiffness against stretch and two shears [N]
    rest: Tensor  # (..., N, 3) strain of bending without loads [1/m]
    # (...,) share by which bending stiffness grows with (radius times bend)^2 [-]
    stiffening: Tensor
    weight: Tensor  # (..., N, 3) weight of the elements [N]
    points: RodPoints  # where masses sit
    loads: Tensor  # (..., P, 3) their weights [N]
    # (..., 3, 3) rotation of the base: its columns are along, y and z of the first section
    base: Tensor
    place: Tensor  # (..., 3) of the base [m]
    offset: Tensor  # (..., T, N, 3) of the tendons from the axis [m]
    slope: Tensor  # (..., T, N, 3) change of that per arc length [-]
    share: Tensor  # (..., T, N) how much of an element a tendon runs through [-]
    pull: Tensor  # (..., T) tension at the base [N]
    friction: Tensor  # (...,) coefficient of friction of a tendon around bends [-]
    wobble: Tensor  # (...,) loss of tension per length, as by a rough channel [1/m]
    rubber: Tensor  # (...,) share by which pressed sections widen and stiffen as rubber does [-]

    def solve(
        self,
        seen: RodPoints,
        offset: Tensor,
        start: Tensor,
        tolerance: float,
        *,
        straight: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Strains in equilibrium (K, S, N, 3) [1/m] and places of points there (K, S, P, 3) [m].

        Args:
            seen: Arc lengths of the points.
            offset: (..., P, 3) from the axis, in the frame of the section [m].
            start: Guess of the strains, (..., S, N, 3) with all poses [1/m].
            tolerance: Largest turn of the last step, of all elements together [rad].
            straight: Whether to come from no tension by small steps at once, without the guess.

        Raises:
            ConvergenceError: no equilibrium is found, on the way from no tension or at rest.
        """
        given = self._op_arguments(start, seen, offset) | {"tolerance": float(tolerance)}
        strains, places, turns = _ops.rod_solve(**given, straight=straight)
        if not bool((is_found := turns.detach() < tolerance).all()):
            rested = self._come_to_rest(strains.shape)
            given["start"] = torch.where(is_found[..., None, None], strains.detach(), rested)
            strains, places, turns = _ops.rod_solve(**given, straight=False)
        most = float(turns.detach().max())
        if not most < tolerance:
            raise ConvergenceError(
                "the rod finds no equilibrium; is a tendon pulled too hard?",
                residual_norm=most,
                tolerance=tolerance,
                num_iters=_ops.MOST_STEPS,
            )
        return strains, places[..., len(self.points.names) :, :]

    @torch.no_grad()
    def _come_to_rest(self, shape: torch.Size) -> Tensor:
        """Strains of rods that have come from unloaded close to rest, (K, S, N, 3) [1/m].

        Each element goes the way that its moment alone would bend it, some of it at a time; less
        where that overshoots.
        """
        strains = _with_lead(self.rest, 2).expand(shape)
        bending, lengths = _with_lead(self.bending, 2), self.shape.edges.diff()
        share = torch.full(shape[:2], REST_SHARE, dtype=torch.float64)
        last = torch.full_like(share, torch.inf)
        for _ in range(REST_STEPS):
            steps = self.survey(strains).residual / bending
            turn = (lengths * steps.norm(dim=-1)).sum(-1)
            if not bool((turn > REST_TURN).any()):
                break
            share = torch.where(turn > OVERSHOT * last, 0.5 * share, share)
            last = turn
            strains = strains - (share / turn.clamp(min=1.0))[..., None, None] * steps
        return strains

    def survey(self, strains: Tensor) -> Survey:
        """What else is known of rods of given strains, (K, S, N, 3) [1/m]."""
        given = self._op_arguments(strains.detach())
        given["strains"] = given.pop("start")
        return Survey(*_ops.rod_survey(**given))

    def _op_arguments(
        self, start: Tensor, seen: RodPoints | None = None, offset: Tensor | None = None
    ) -> dict[str, Any]:
        points, offsets = self.points, [_with_lead(self.points.offset, 2)]
        at, around = [points.at], [points.element]
        if seen is not None and offset is not None:
            at, around = [*at, seen.at], [*around, seen.element]
            offsets.append(_with_lead(offset, 2))
        own = {
            name: _with_lead(getattr(self, name), len(spec.shape) - 2)
            for name, spec in _ops.FIELDS.items()
            if name != "points"
        }
        own["start"] = _with_lead(start, 2)
        shared = _lead_of(offsets)
        own["points"] = torch.cat([value.expand(*shared, -1, -1) for value in offsets], -2)
        rows, columns = _lead_of(own.values())
        return own | {
            "edges": self.shape.edges,
            "radius": self.shape.radius,
            "point_at": torch.cat(at),
            "around": torch.cat(around),
            "rows": rows,
            "columns": columns,
            "num_threads": torch.get_num_threads(),
        }


def _with_lead(value: Tensor, axes: int) -> Tensor:
    """A tensor with two leading axes before its own ones."""
    return value[(None,) * (axes + 2 - value.ndim)] if value.ndim < axes + 2 else value


def _lead_of(values: Iterable[Tensor]) -> tuple[int, int]:
    """Leading axes of tensors together, each of which has the whole axis or one."""
    rows, columns = zip(*(value.shape[:2] for value in values), strict=True)
    return max(rows), max(columns)
