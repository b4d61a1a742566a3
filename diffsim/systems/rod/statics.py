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
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.core.errors import ConvergenceError
from diffsim.core.rotation import cross, matrix_from_rotation_vector
from diffsim.systems.rod.layout import RodPoints, RodShape

STRETCH_ROUNDS = 4  # each gains about two digits: tendons compress by a few percent
MOST_TURN = 0.5  # of all elements together in one step of Newton's method [rad]
MOST_STEPS = 40
SHRINKS = 0.7  # factor by which steps with foreign slopes become shorter, or they are given up
MIXED = 3  # earlier steps that the next one learns from
RIDGE = 1e-10  # of scaled differences: where they are alike, none is preferred
DIFFERENCE = 1e-5  # step of difference quotients by strains [1/m]
MOST_PRESSED = 0.2  # stretch below which rubber stiffens no further: solvers pass through it
SMOOTHING = 1e-3  # bends below this do not count as a kink of a tendon [1/m]


def running_products(steps: Tensor) -> Tensor:
    """Products steps[0] ... steps[k] along the third last axis, (..., N, 3, 3), by doubling."""
    reach, count = 1, steps.shape[-3]
    while reach < count:
        longer = steps[..., :-reach, :, :] @ steps[..., reach:, :, :]
        steps = torch.cat([steps[..., :reach, :, :], longer], -3)
        reach *= 2
    return steps


class _SectionFactors(NamedTuple):
    """Factors by which sections differ from those without loads.

    Attributes:
        width: (..., N) of the radius.
        bending: (..., N, 3) of the stiffness against twist and bends.
        stretch: (..., N, 3) of the stiffness against stretch and shears.
    """

    width: Tensor
    bending: Tensor
    stretch: Tensor


@dataclass(frozen=True, eq=False)
class RodStatics:
    """All numbers of an equilibrium; leading axes (...) are alike or one.

    Attributes:
        shape: Elements.
        bending: (..., N, 3) stiffness against twist and two bendings [N m^2].
        stretch: (..., N, 3) stiffness against stretch and two shears [N].
        rest: (..., N, 3) strain of bending without loads [1/m].
        stiffening: (...,) share by which bending stiffness grows with (radius times bend)^2 [-].
        weight: (..., N, 3) weight of the elements [N].
        points: Where masses sit.
        loads: (..., P, 3) their weights [N].
        base: (..., 3, 3) rotation of the base: its columns are along, y and z of the first section.
        place: (..., 3) of the base [m].
        offset: (..., T, N, 3) of the tendons from the axis [m].
        slope: (..., T, N, 3) change of that per arc length [-].
        share: (..., T, N) how much of an element a tendon runs through [-].
        pull: (..., T) tension at the base [N].
        friction: (...,) coefficient of friction of a tendon around bends [-].
        wobble: (...,) loss of tension per length, as by a rough channel [1/m].
        rubber: (...,) share by which pressed sections widen and stiffen as rubber does [-].
    """

    shape: RodShape
    bending: Tensor
    stretch: Tensor
    rest: Tensor
    stiffening: Tensor
    weight: Tensor
    points: RodPoints
    loads: Tensor
    base: Tensor
    place: Tensor
    offset: Tensor
    slope: Tensor
    share: Tensor
    pull: Tensor
    friction: Tensor
    wobble: Tensor
    rubber: Tensor

    def with_pull(self, factor: float) -> RodStatics:
        """The rod with a share of all tensions."""
        return replace(self, pull=factor * self.pull)

    def row(self, k: int) -> RodStatics:
        """The rod of one row of the first of two leading axes."""
        own = {}
        for name, axes in _AXES.items():
            value = getattr(self, name)
            if value.ndim > axes + 1:
                value = value[k if value.shape[0] > 1 else 0]
            own[name] = value
        return replace(self, **own)

    def frames(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations at the edges, (..., N + 1, 3, 3), and at the middles, (..., N, 3, 3)."""
        steps = u * self.shape.lengths[:, None]
        after = self.base[..., None, :, :] @ running_products(matrix_from_rotation_vector(steps))
        first = self.base[..., None, :, :].expand(*after.shape[:-3], 1, 3, 3)
        edges = torch.cat([first, after], -3)
        return edges, edges[..., :-1, :, :] @ matrix_from_rotation_vector(0.5 * steps)

    def tension(self, u: Tensor) -> Tensor:
        """(..., T, N) tension of the tendons at the middles [N]."""
        turn = self.shape.lengths * (u[..., 1:].square().sum(-1) + SMOOTHING**2).sqrt()
        wrapped = turn.cumsum(-1) - 0.5 * turn
        loss = self.friction[..., None] * wrapped + self.wobble[..., None] * self.shape.middles
        return self.pull[..., None] * self.share * torch.exp(-loss)[..., None, :]

    def section(self, u: Tensor, force: Tensor) -> tuple[Tensor, Tensor]:
        """Stretch and moment of the sections.

        Args:
            u: (..., N, 3) twist and bends [1/m].
            force: (..., N, 3) force that acts beyond the section, in its frame [N].

        Returns:
            Stretch and shears (..., N, 3) [-], 1 0 0 at rest, and moment of body and tendons
            (..., N, 3) [N m].
        """
        tension = self.tension(u)[..., None]
        along = torch.tensor([1.0, 0.0, 0.0], dtype=u.dtype)
        v = along + force / self.stretch
        for _ in range(STRETCH_ROUNDS):
            factors = self._section_factors(v)
            offset = factors.width[..., None, :, None] * self.offset
            tangent = v[..., None, :, :] + cross(u[..., None, :, :], offset) + self.slope
            pull = tension * tangent / tangent.square().sum(-1, keepdim=True).sqrt()
            v = along + (force - pull.sum(-3)) / (self.stretch * factors.stretch)
        bent = u - self.rest
        strain = (bent[..., 1:].square().sum(-1) * self.shape.radius**2)[..., None]
        moment = self.bending * bent * (1.0 + self.stiffening[..., None, None] * strain)
        factors = self._section_factors(v)
        levers = cross(factors.width[..., None, :, None] * self.offset, pull)
        return v, factors.bending * moment + levers.sum(-3)

    def _section_factors(self, v: Tensor) -> _SectionFactors:
        """What stretch and shears v (..., N, 3) make of the sections."""
        y = v[..., 0].clamp(min=MOST_PRESSED)
        share = self.rubber[..., None]
        secant = 1.0 + share * ((1.0 + 1.0 / y + y**-2) / 3.0 - 1.0)  # P / (E (y - 1))
        flexural = 1.0 + share * ((1.0 + 2.0 * y**-3) / (3.0 * y) - 1.0)
        twist, shear = 1.0 + share * (1.0 / y - 1.0), torch.ones_like(secant)
        return _SectionFactors(
            1.0 + share * (y**-0.5 - 1.0),
            torch.stack([twist, flexural, flexural], -1),
            torch.stack([secant, shear, shear], -1),
        )

    def at_points(self, points: RodPoints, offset: Tensor, u: Tensor) -> Tensor:
        """Places (..., P, 3) of points fixed to sections [m].

        Args:
            points: Their arc lengths.
            offset: (..., P, 3) from the axis, in the frame of the section [m].
            u: (..., N, 3) twist and bends [1/m].
        """
        v, edges, nodes = self._integrate_course(u)
        return _place_points(self.shape, points, offset, u, v, edges, nodes)

    def course(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations (..., N + 1, 3, 3) and places (..., N + 1, 3) [m] of the sections at the edges.

        Args:
            u: (..., N, 3) twist and bends [1/m].
        """
        return self._integrate_course(u)[1:]

    def _integrate_course(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Stretch and shears, and what ``course`` returns."""
        edges, middles = self.frames(u)
        force = self._sum_forces(middles)[0]
        v, _ = self.section(u, _rotate_into(middles, force))
        return v, edges, self._integrate_places(middles, v)[0]

    def residual(self, u: Tensor) -> Tensor:
        """(..., N, 3) moment that is left over in the sections [N m]."""
        edges, middles = self.frames(u)
        force, beyond = self._sum_forces(middles)
        v, moment = self.section(u, _rotate_into(middles, force))
        nodes, centers = self._integrate_places(middles, v)
        torque = cross(centers, self.weight)
        outer = torque.flip(-2).cumsum(-2).flip(-2) - torque  # of all elements beyond
        lever = 0.25 * self.shape.lengths[:, None] * (middles @ v[..., None])[..., 0]
        outer = outer + cross(centers + lever, 0.5 * self.weight)
        if len(self.points.names):
            at = _place_points(self.shape, self.points, self.points.offset, u, v, edges, nodes)
            outer = outer + beyond @ cross(at, self.loads)
        return moment - _rotate_into(middles, outer - cross(centers, force))

    def _sum_forces(self, middles: Tensor) -> tuple[Tensor, Tensor]:
        """Force that acts beyond the middles, (..., N, 3) [N], and (N, P) which points do."""
        weight = self.weight.expand(*middles.shape[:-1])
        force = weight.flip(-2).cumsum(-2).flip(-2) - 0.5 * weight
        beyond = (self.points.at > self.shape.middles[:, None]).to(force.dtype)
        if len(self.points.names):
            force = force + beyond @ self.loads
        return force, beyond

    def _integrate_places(self, middles: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Places of the edges (..., N + 1, 3) and of the middles (..., N, 3) [m]."""
        steps = (middles @ v[..., None])[..., 0] * self.shape.lengths[:, None]
        after = self.place[..., None, :] + steps.cumsum(-2)
        first = self.place[..., None, :].expand(*after.shape[:-2], 1, 3)
        nodes = torch.cat([first, after], -2)
        return nodes, nodes[..., :-1, :] + 0.5 * steps


_AXES = {
    "bending": 2, "stretch": 2, "rest": 2, "stiffening": 0, "weight": 2, "loads": 2, "base": 2,
    "place": 1, "offset": 3, "slope": 3, "share": 2, "pull": 1, "friction": 0, "wobble": 0,
    "rubber": 0,
}  # fmt: skip
"""Own axes of the tensors of a rod, behind the leading ones."""


def _rotate_into(frames: Tensor, vectors: Tensor) -> Tensor:
    """Components of vectors (..., 3) in frames (..., 3, 3)."""
    return (frames.mT @ vectors[..., None])[..., 0]


def _place_points(
    shape: RodShape,
    points: RodPoints,
    offset: Tensor,
    u: Tensor,
    v: Tensor,
    edges: Tensor,
    nodes: Tensor,
) -> Tensor:
    i = points.element
    past = (points.at - shape.edges[i])[:, None]
    own = u[..., i, :]
    frame = edges[..., i, :, :]
    half = frame @ matrix_from_rotation_vector(0.5 * past * own)
    axis = nodes[..., i, :] + (half @ (past * v[..., i, :])[..., None])[..., 0]
    return axis + ((frame @ matrix_from_rotation_vector(past * own)) @ offset[..., None])[..., 0]


def _compute_slopes(rod: RodStatics, u: Tensor) -> Tensor:
    """Derivatives (B, 3 N, 3 N) of the residual by u (B, N, 3), by central differences: right to
    nine digits, and all in one call."""
    size = u.shape[-2] * 3
    moves = DIFFERENCE * torch.eye(size, dtype=u.dtype).reshape(size, 1, *u.shape[-2:])
    ahead, behind = rod.residual(torch.stack([u + moves, u - moves]))
    return ((ahead - behind) / (2.0 * DIFFERENCE)).flatten(2).permute(1, 2, 0)


def _solve_by_newton(rod: RodStatics, u: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
    """Equilibria from a guess (B, N, 3), and the slopes there.

    Raises:
        ConvergenceError: it does not settle.
    """
    most = float("inf")
    for _ in range(MOST_STEPS):
        slopes = _compute_slopes(rod, u)
        step = torch.linalg.solve(slopes, rod.residual(u).flatten(1)).reshape(u.shape)
        turn = (step.norm(dim=-1) * rod.shape.lengths).sum(-1)
        most = float(turn.max())
        if not math.isfinite(most):
            break
        u = u - (MOST_TURN / turn).clamp(max=1.0)[:, None, None] * step
        if most < tolerance:
            return u, slopes
    raise ConvergenceError(
        "the rod finds no equilibrium; is a tendon pulled too hard?",
        residual_norm=most,
        tolerance=tolerance,
        num_iters=MOST_STEPS,
    )


def equilibrium(
    rod: RodStatics, start: Tensor, tolerance: float, *, straight: bool = False
) -> tuple[Tensor, Tensor]:
    """Equilibria without gradients.

    Args:
        rod: Rod with one leading axis of B rows.
        start: Guess of the bending strains, (B, N, 3) [1/m].
        tolerance: Largest turn of the last step, of all elements together [rad].
        straight: Whether to come from no tension by small steps, from the guess.

    Returns:
        Strains (B, N, 3) and slopes of the residual there (B, 3 N, 3 N).

    Raises:
        ConvergenceError: no equilibrium is found on the way from no tension.
    """
    if not straight:
        try:
            return _solve_by_newton(rod, start, tolerance)
        except ConvergenceError:
            start = torch.zeros_like(start)
    found, share, step = start, 0.0, 0.25
    found, slopes = _solve_by_newton(rod.with_pull(0.0), found, 1e-3)
    while share < 1.0:
        tried = min(1.0, share + step)
        try:
            found, slopes = _solve_by_newton(
                rod.with_pull(tried), found, tolerance if tried == 1.0 else 1e-3
            )
        except ConvergenceError:
            step *= 0.5
            if step < 0.01:
                raise
        else:
            share = tried
    return found, slopes


def nearby(
    residual: Callable[[Tensor], Tensor],
    u: Tensor,
    slopes: Tensor,
    lengths: Tensor,
    tolerance: float,
) -> Tensor | None:
    """Equilibria of rows that differ little from one whose slopes are known; None: too much.

    Args:
        residual: Function of strains (K, S, N, 3).
        u: Strains of the known equilibria, for each row, (K, S, N, 3).
        slopes: Slopes there, (S, 3 N, 3 N).
        lengths: (N,) of the elements [m].
        tolerance: As of :func:`equilibrium`.
    """
    factor = torch.linalg.lu_factor(slopes)
    last, before = float("inf"), Mixing()
    for _ in range(MOST_STEPS):
        left = residual(u)
        step = torch.linalg.lu_solve(*factor, left.flatten(2).permute(1, 2, 0))
        step = step.permute(2, 0, 1).reshape(left.shape)
        most = float((step.norm(dim=-1) * lengths).sum(-1).max())
        if not most < SHRINKS * last:
            return None
        if most < tolerance:
            return u - step
        u, last = before.next(u, step), most
    return None


class Mixing:
    """Anderson's mixing of a fixed-point iteration, each row by itself.

    Steps with slopes of another place shrink the error by a constant factor. What the last steps
    changed shows most of what the slopes lack.

    Source: Walker and Ni, Anderson acceleration for fixed-point iterations, SIAM J. Numer. Anal. 49
    (2011) 1715, eq. 2.2.
    """

    def __init__(self) -> None:
        self.places: list[Tensor] = []
        self.steps: list[Tensor] = []

    def next(self, u: Tensor, step: Tensor) -> Tensor:
        """The next place of each row.

        Args:
            u: Places, (K, S, N, 3).
            step: What the iteration itself would take off, the same shape.
        """
        self.places = [*self.places, u.flatten(2)][-MIXED - 1 :]
        self.steps = [*self.steps, -step.flatten(2)][-MIXED - 1 :]
        plain = u - step
        if len(self.steps) < 2:
            return plain
        moves = torch.stack(self.places, -1).diff(dim=-1)
        turns = torch.stack(self.steps, -1).diff(dim=-1)
        scale = turns.norm(dim=-2, keepdim=True).clamp_min(1e-300)
        moves, turns = moves / scale, turns / scale
        inner = turns.mT @ turns + RIDGE * torch.eye(turns.shape[-1], dtype=u.dtype)
        shares = torch.linalg.solve(inner, turns.mT @ self.steps[-1][..., None])
        return plain - ((moves + turns) @ shares)[..., 0].reshape(u.shape)


__all__ = ["RodStatics", "equilibrium", "nearby", "running_products"]
