"""Streamlines of a flow: curves along the velocity, many at a time, in two or three dimensions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor

from diffsim.core.arrays import Array, IntArray, Mask
from diffsim.core.check import require, require_choice, require_number
from diffsim.core.checked import checked
from diffsim.core.numbers import to_numpy
from diffsim.stokes.field import FlowField
from diffsim.stokes.grid import Grid

ENDS = ("length", "box", "wall", "rest", "closed")
"""Why a line ended: its greatest length; it left the box; it met the wall; the fluid rests there;
it came back to its seed."""

_REST = 1e-6  # of the largest speed: slower fluid counts as resting [-]
_MIN_STEP = 1e-3  # [cells]: the multilinear field has kinks that no tolerance resolves
_SAMPLES = 8  # per cell and axis, where seeds are spread over an inlet

# Dormand-Prince 5(4)
_A = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
_ERROR = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)


@dataclass(frozen=True, kw_only=True)
class Streamline:
    """One line."""

    points: Array  # points of the line, (n, dim) [m], in the direction of the flow
    speed: Array  # speed at the points, (n,) [m/s]
    time: Array  # time along the line from its first point, (n,) [s]
    end: str  # why it ended downstream, one of ``ENDS``
    start: str = "seed"  # why it ended upstream; "seed" where it was not followed there

    @property
    def length(self) -> float:
        """Length of the line [m]."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())


@checked
def streamlines(
    field: FlowField,
    seeds: Tensor | int = 24,
    *,
    case: int = 0,
    direction: str = "downstream",
    max_length: float | None = None,
    tolerance: float = 1e-5,
    max_step: float = 0.5,
) -> list[Streamline]:
    """Follow the velocity from seeds until the line leaves the fluid, rests, or closes.

    dx/ds = v / |v| by Dormand-Prince 5(4) with a step of its own for every line, in the multilinear
    field of the nodes' velocities.

    Args:
        seeds: Points in the fluid, (n, dim) float64 [m], or how many to spread over the inlets (see
            ``inlet_seeds``).
        case: Index of one of the field's cases.
        direction: "downstream", "upstream" or "both".
        max_length: Greatest length per direction [m]; default ten times the longest side of the
            box.
        tolerance: Largest error per step [cells].
        max_step: Longest step [cells].

    Returns:
        One ``Streamline`` per seed, in their order; a seed outside of the fluid has one point.
    """
    require_choice("direction", direction, ["downstream", "upstream", "both"])
    require_number("tolerance", tolerance, above=0.0)
    require_number("max_step", max_step, above=0.0)
    grid = field.grid
    if max_length is None:
        max_length = 10.0 * max(grid.size)
    require_number("max_length", max_length, above=0.0)
    velocity = _case(field, case)
    if isinstance(seeds, int):
        seeds = inlet_seeds(field, seeds, case=case)
    start = to_numpy("seeds", require("seeds", seeds, ("n", grid.dim)))
    sampler = _Sampler(grid, velocity, to_numpy("field.phi", field.phi))
    if bool((~sampler.in_box(sampler.scaled(start))).any()):
        raise ValueError("seeds must lie in the box")
    options = (max_length, tolerance, max_step)
    down = up = None
    if direction != "upstream":
        down = _follow(sampler, start, 1.0, *options)
    if direction != "downstream":
        up = _follow(sampler, start, -1.0, *options)
    if down is None or up is None:
        lines, ends = down or up or ([], [])
        if down is None:
            return [_line(sampler, p[::-1], "seed", e) for p, e in zip(lines, ends, strict=True)]
        return [_line(sampler, p, e, "seed") for p, e in zip(lines, ends, strict=True)]
    both = []
    for p, end, q, begin in zip(*down, *up, strict=True):
        whole = p if end == "closed" else np.concatenate([q[:0:-1], p])
        both.append(_line(sampler, whole, end, begin))
    return both


@checked
def inlet_seeds(field: FlowField, count: int, *, case: int = 0) -> Tensor:
    """Points on the faces of the box where fluid enters, each for an equal share of the inflow.

    In 2D, neighboring streamlines then bound equal flows. In 3D the inflow of a face is cut into
    strips, and those into pieces.

    Args:
        case: Index of one of the field's cases.

    Returns:
        (count, dim) float64 [m].

    Raises:
        ValueError: nothing flows into the box.
    """
    require_number("count", count, at_least=1)
    grid = field.grid
    velocity, phi = _case(field, case), to_numpy("field.phi", field.phi)
    sampler = _Sampler(grid, velocity, phi)
    points, flows = [], []
    for face in grid.faces:
        axis, side = grid.face_axis(face)
        others = [a for a in range(grid.dim) if a != axis]
        counts = [_SAMPLES * grid.shape[a] for a in others]
        at = np.meshgrid(*[(np.arange(n) + 0.5) / _SAMPLES for n in counts], indexing="ij")
        scaled = np.zeros((*counts, grid.dim))
        scaled[..., others] = np.stack(at, -1)
        scaled[..., axis] = side * grid.shape[axis]
        v, level = sampler(scaled.reshape(-1, grid.dim))
        inflow = np.where(level > 0.0, v[:, axis] * (1.0 - 2.0 * side), 0.0).clip(min=0.0)
        area = grid.cell_volume / grid.spacing[axis]
        points.append(scaled)
        flows.append(area * inflow.reshape(counts))
    total = np.array([f.sum() for f in flows])
    small = _REST * float(np.linalg.norm(velocity, axis=-1).max(initial=0.0))
    # continued velocities next to a wall let traces through faces where nothing enters
    total[total < 1e-3 * total.sum()] = 0.0
    if total.sum() <= small * grid.cell_volume / max(grid.spacing):
        raise ValueError("nothing flows into the box: give seeds as points (n, dim) [m]")
    chosen = []
    last = 0
    for k, edge in enumerate(np.cumsum(total) / total.sum() * count):
        share = round(float(edge)) - last
        last += share
        if share and total[k] > 0.0:
            index = _equal_shares(flows[k], share)
            chosen.append(points[k].reshape(-1, grid.dim)[index])
    scaled = np.concatenate(chosen)
    return torch.from_numpy(np.array(grid.origin) + scaled * np.array(grid.spacing))


def _equal_shares(flow: Array, count: int) -> IntArray:
    """Flat indices of samples in the middle of ``count`` equal parts of a flow over a face."""
    if flow.ndim == 1:
        return _quantiles(flow, count)
    used = [int(np.count_nonzero(flow.sum(1 - a))) for a in range(2)]
    strips = min(count, max(1, round(math.sqrt(count * used[0] / max(used[1], 1)))))
    cumulative = np.cumsum(flow.sum(1)) / flow.sum()
    strip = np.minimum((cumulative * strips - 1e-9).astype(np.int64).clip(min=0), strips - 1)
    out = []
    for k in range(strips):
        share = (k + 1) * count // strips - k * count // strips
        rows = np.flatnonzero(strip == k)
        if not len(rows):  # a strip thinner than a sample
            rows = np.array([min(int(np.searchsorted(cumulative, (k + 0.5) / strips)),
                                 len(flow) - 1)])  # fmt: skip
        columns = _quantiles(flow[rows].sum(0), share)
        middle = rows[_quantiles(flow[rows].sum(1), 1)[0]]
        for column in columns:
            row = middle
            if flow[row, column] <= 0.0:
                row = rows[int(flow[rows, column].argmax())]
            out.append(row * flow.shape[1] + column)
    return np.array(out, dtype=np.int64)


def _quantiles(flow: Array, count: int) -> IntArray:
    cumulative = np.cumsum(flow)
    at = (np.arange(count) + 0.5) / count * cumulative[-1]
    return np.minimum(np.searchsorted(cumulative, at), len(flow) - 1)


class _Sampler:
    """Velocity [m/s] and level set at points, in units of cells from the box's corner."""

    def __init__(self, grid: Grid, velocity: Array, phi: Array):
        self.dim, self.cells = grid.dim, np.array(grid.shape, dtype=float)
        self.origin, self.spacing = np.array(grid.origin), np.array(grid.spacing)
        self.nodes = [*np.moveaxis(velocity, -1, 0), phi]
        self.slowest = _REST * float(np.linalg.norm(velocity, axis=-1).max(initial=0.0))

    def scaled(self, points: Array) -> Array:
        return (points - self.origin) / self.spacing

    def in_box(self, at: Array) -> Mask:
        return np.all((at >= -1e-9) & (at <= self.cells + 1e-9), axis=-1)

    def __call__(self, at: Array) -> tuple[Array, Array]:
        # beyond the box, the value at its face
        found = [map_coordinates(n, at.T, order=1, mode="nearest") for n in self.nodes]
        return np.stack(found[:-1], -1), found[-1]

    def along(self, at: Array, sign: float) -> Array:
        """Unit steps along the flow in meters, as cells per meter; zero where it rests."""
        v, _ = self(at)
        speed = np.linalg.norm(v, axis=-1, keepdims=True)
        unit = np.divide(sign * v, speed, out=np.zeros_like(v), where=speed > self.slowest)
        return unit / self.spacing


def _follow(
    sampler: _Sampler,
    start: Array,
    sign: float,
    max_length: float,
    tolerance: float,
    max_step: float,
) -> tuple[list[Array], list[str]]:
    """Points (n, dim) [cells] and end of the line of every seed."""
    count = len(start)
    cell = float(sampler.spacing.min())
    at = sampler.scaled(start)
    seed = at.copy()
    step = np.full(count, 0.1 * max_step * cell)
    length, farthest = np.zeros(count), np.zeros(count)
    end = np.full(count, -1)
    lines = [[p] for p in seed]
    v, level = sampler(at)
    end[np.linalg.norm(v, axis=-1) <= sampler.slowest] = ENDS.index("rest")
    end[level <= 0.0] = ENDS.index("wall")
    while bool((end < 0).any()):
        going = np.flatnonzero(end < 0)
        h = np.minimum(step[going], max_length - length[going])[:, None]
        x = at[going]
        slopes = [sampler.along(x, sign)]
        for row in _A:
            slopes.append(
                sampler.along(x + h * sum(a * k for a, k in zip(row, slopes, strict=True)), sign)
            )
        new = x + h * sum(a * k for a, k in zip(_A[-1], slopes, strict=False))
        error = np.abs(h * sum(e * k for e, k in zip(_ERROR, slopes, strict=True))).max(-1)
        fine = (error <= tolerance) | (h[:, 0] <= 1.01 * _MIN_STEP * cell)
        factor = 0.9 * (tolerance / np.maximum(error, 1e-12 * tolerance)) ** 0.2
        step[going] = (h[:, 0] * factor.clip(0.2, 4.0)).clip(_MIN_STEP * cell, max_step * cell)
        going, x, new, h = going[fine], x[fine], new[fine], h[fine, 0]
        new, left = _clip_to_box(sampler, x, new)
        v, level = sampler(new)
        solid = (level <= 0.0) & ~left
        new[solid] = _to_wall(sampler, x[solid], new[solid])
        away = np.linalg.norm((new - seed[going]) * sampler.spacing, axis=-1)
        farthest[going] = np.maximum(farthest[going], away)
        home = _passes(seed[going], x, new, sampler.spacing) & (farthest[going] > 2.0 * cell)
        home &= length[going] > 2.0 * farthest[going]
        new[home] = seed[going][home]
        length[going] += h
        at[going] = new
        for i, p in zip(going, new, strict=True):
            lines[i].append(p)
        end[going[np.linalg.norm(v, axis=-1) <= sampler.slowest]] = ENDS.index("rest")
        end[going[length[going] >= max_length * (1.0 - 1e-12)]] = ENDS.index("length")
        end[going[solid]] = ENDS.index("wall")
        end[going[left]] = ENDS.index("box")
        end[going[home]] = ENDS.index("closed")
    return [np.array(line) for line in lines], [ENDS[k] for k in end]


def _clip_to_box(sampler: _Sampler, x: Array, new: Array) -> tuple[Array, Mask]:
    """Steps cut where they leave the box."""
    move = new - x
    with np.errstate(divide="ignore", invalid="ignore"):
        room = np.where(move > 0, (sampler.cells - x) / move, np.where(move < 0, -x / move, np.inf))
    share = room.min(-1, initial=np.inf)
    left = share < 1.0
    clipped = np.clip(x + share.clip(0.0, 1.0)[:, None] * move, 0.0, sampler.cells)
    return np.where(left[:, None], clipped, new), left


def _to_wall(sampler: _Sampler, x: Array, new: Array) -> Array:
    """Where steps from fluid into solid meet the wall, by bisection."""
    low, high = np.zeros(len(x)), np.ones(len(x))
    for _ in range(20):
        middle = 0.5 * (low + high)
        _, level = sampler(x + middle[:, None] * (new - x))
        low, high = np.where(level > 0, middle, low), np.where(level > 0, high, middle)
    return x + low[:, None] * (new - x)


def _passes(seed: Array, x: Array, new: Array, spacing: Array) -> Mask:
    """Whether steps pass their seed within a hundredth of a cell."""
    move, away = (new - x) * spacing, (seed - x) * spacing
    square = np.maximum((move**2).sum(-1), np.finfo(float).tiny)
    share = ((move * away).sum(-1) / square).clip(0.0, 1.0)
    gap = np.linalg.norm(away - share[:, None] * move, axis=-1)
    # the chord of a curved step misses the seed by a little more than the curve
    return gap < 0.01 * spacing.min() + 0.05 * np.sqrt(square)


def _line(sampler: _Sampler, at: Array, end: str, start: str) -> Streamline:
    v, _ = sampler(at)
    speed = np.linalg.norm(v, axis=-1)
    points = sampler.origin + at * sampler.spacing
    step = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    mean = np.maximum(0.5 * (speed[1:] + speed[:-1]), np.finfo(float).tiny)
    time = np.concatenate([[0.0], np.cumsum(step / mean)])
    return Streamline(points=points, speed=speed, time=time, end=end, start=start)


def _case(field: FlowField, case: int) -> Array:
    if isinstance(case, bool) or not isinstance(case, int):
        raise TypeError(f"case must be an integer, got {type(case).__name__}")
    cases = len(field.velocity)
    if not 0 <= case < cases:
        raise ValueError(f"case must lie in [0, {cases}), got {case}")
    velocity = require("field.velocity", field.velocity, field.velocity.shape)
    return to_numpy("field.velocity", velocity[case].detach())
