"""A soft body bent by one chamber, reduced to its bending angle q.

    q'' + 2 zeta w q' + w^2 (q - creep) = w^2 moment(p(t)),   p: the chamber's pressure

Softening and stiffening act on both springs of the standard linear solid, so that a body that
creeps stays stable however soft.

The body bends as an arc of constant curvature (Webster and Jones, IJRR 29, 2010), the neutral axis
off the middle, so that it lengthens as it bends; markers sit on the end's rigid face. Many points
at once, (K,) each. Trapezoidal rule of ``STEP`` for the mode, the pressure in closed form.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim.data.study import Run
from diffsim.systems.bending.response import filled, linear_mode

Array = NDArray[np.float64]
STEP = 0.002  # [s]; twice that moves the arm's record by 2.1 noise sd, beyond the gate
SECOND = 6.27  # second natural frequency of a uniform cantilever over its first
QUIET = 5.0  # times as long steps where nothing was switched for ``LIVELY``
LIVELY, EARLY = 1.0, 0.1  # [s] after and before a switch
LEAST = 0.05  # share of its stiffness that a ballooning chamber or a softened body keeps
PRESSURE_UNIT = 1e5  # [Pa], so that sizes are of order one
#: What effects change, with its value in the plain model.
PLAIN = {
    "fill_lag": 0.0,
    "vent_lag": 0.0,
    "flow_limit": 0.0,
    "slow_fill": 0.0,
    "dead_band": 0.0,
    "moment_growth": 0.0,
    "ballooning": 0.0,
    "stiffness_loss": 0.0,
    "stiffening": 0.0,
    "creep": 0.0,
    "second_mode": 0.0,
    "damping_growth": 0.0,
    "quadratic_drag": 0.0,
    "hanging": 0.0,
    "sideways": 0.0,
    "drift": 0.0,
    "direction_drift": 0.0,
    "twist": 0.0,
    "scale": 0.0,
    "frame_along": 0.0,
    "frame_across": 0.0,
}


@dataclass(frozen=True, eq=False)
class Layout:
    """Which coordinates of the laboratory are along and across the body, and what is fixed.

    Attributes:
        axes: Indices of the axis and of the two lateral directions.
        moving: Number of markers at the end; those after them are clamped.
        command: Name of the command that bends the body.
        unit: Value of the command for which ``p = 1`` [unit of the command].
    """

    axes: tuple[int, int, int]
    moving: int
    command: str
    unit: float


@dataclass(frozen=True, eq=False)
class BendingScene:
    """One run of a bending body.

    Attributes:
        values: Base parameters (of this run without "@run") and ``PLAIN``, (K,) each.
        run: Recorded run, with its measured rest before the step.
        layout: Axes and command of the set-up.
        step: Time step of the integrator [s].
        single: Whether one point was asked for, without a batch axis.
        knots: (m, K) of a moment in time besides [rad], straight lines between them; None: none.
        spacing: Time between two knots [s]; the first knot is at the run's start.
    """

    values: Mapping[str, Array]
    run: Run
    layout: Layout
    step: float
    single: bool
    knots: Array | None = None
    spacing: float = 1.0

    def with_moment(self, knots: Tensor, spacing: float) -> BendingScene:
        """A copy with a moment (m,) or (K, m), as the angle that it holds [rad]."""
        rows = np.atleast_2d(knots.detach().numpy()).T
        return replace(self, knots=rows, spacing=spacing)

    def with_added(self, name: str, size: Tensor) -> BendingScene:
        """A copy with one number larger by ``size`` () or (K,)."""
        more = np.atleast_1d(size.detach().numpy())
        return replace(self, values={**self.values, name: self.values[name] + more})

    def simulate(self) -> Tensor:
        """(..., T, 3 markers) places [m]."""
        time = self.run.time_s
        grid = self._grid()
        pressure = self._pressure(grid)
        moment = self._moment(pressure)
        if self.knots is not None:
            place = np.minimum((grid - grid[0]) / self.spacing, len(self.knots) - 1.001)
            left, share = place.astype(int), (place % 1.0)[:, None]
            moment = moment + (1.0 - share) * self.knots[left] + share * self.knots[left + 1]
        angle = self._angle(grid, pressure, moment)
        if np.any(self.values["second_mode"]):
            angle = angle + self.values["second_mode"] * self._second(grid, moment)
        left = np.clip(np.searchsorted(grid, time, side="right") - 1, 0, len(grid) - 2)
        share = ((time - grid[left]) / (grid[left + 1] - grid[left]))[:, None]
        out = self._markers((1.0 - share) * angle[left] + share * angle[left + 1])
        return torch.from_numpy(out[0] if self.single else out)

    def _grid(self) -> Array:
        """Times of the integrator: ``step`` apart after a switch, ``QUIET`` times that later."""
        time, command = self.run.time_s, self.run.command[self.layout.command]
        switches = time[np.flatnonzero(np.diff(command)) + 1]
        grid = [time[0]]
        while grid[-1] < time[-1]:
            since = grid[-1] - switches
            is_lively = bool(((since > -EARLY) & (since < LIVELY)).any())
            grid.append(grid[-1] + (1.0 if is_lively else QUIET) * self.step)
        return np.array(grid)

    def _pressure(self, time: Array) -> Array:
        """(T, K) in the chamber: filled from the onset to the release, through the lags."""
        v, command = self.values, self.run.command[self.layout.command]
        level = command.max() / self.layout.unit
        on = np.flatnonzero(command > 0.0)
        start = self.run.time_s[on[0]] + v["onset"]
        since = time[:, None] - start
        lag = v["fill_lag"] + v["flow_limit"] * level
        full = filled(since, lag)
        slow = filled(since, v["slow_time"])
        rising = (1.0 - v["slow_fill"]) * full + v["slow_fill"] * slow
        out = level * rising
        if on[-1] + 1 < len(command):
            end = self.run.time_s[on[-1] + 1] + v["release"]
            left = 1.0 - filled(time[:, None] - end, v["vent_lag"])
            out = out * left
        return np.asarray(out)

    def _moment(self, p: Array) -> Array:
        """Bending angle that a pressure holds in the end, without creep and softening."""
        v = self.values
        p = np.maximum(p - v["dead_band"], 0.0) if np.any(v["dead_band"]) else p
        growth = 1.0 + v["moment_growth"] * p
        growth = growth / np.maximum(1.0 - v["ballooning"] * p, LEAST)
        return np.asarray(v["gain"] * growth * p * (1.0 + v["drift"] * self.run.order))

    def _second(self, grid: Array, moment: Array) -> Array:
        """(T, K) of a second mode under a moment, of equal damping ratio."""
        v = self.values
        w = 2.0 * np.pi * v["frequency"] * SECOND
        return linear_mode(w, v["damping_ratio"], moment, np.diff(grid))

    def _angle(self, grid: Array, pressure: Array, held_angle: Array) -> Array:
        """(T, K) bending angle: trapezoidal rule, each step linearized at its start.

        Args:
            grid: Times of the grid, (T,) [s].
            pressure: Pressure in the chamber over that of ``p = 1``, (T, K) [-].
            held_angle: (T, K) moment, as the angle that it holds in the end.
        """
        v, steps = self.values, np.diff(grid)
        w2 = (2.0 * np.pi * v["frequency"]) ** 2
        rate = 2.0 * v["damping_ratio"] * np.sqrt(w2)
        held = v["creep"] / (1.0 + v["creep"])
        forgotten = np.exp(-steps[:, None] / v["slow_time"])
        moment = w2 * held_angle
        softened = w2 * np.maximum(1.0 - v["stiffness_loss"] * pressure, LEAST)
        damped = rate * np.maximum(1.0 + v["damping_growth"] * pressure, LEAST)
        drag, cubic = v["quadratic_drag"], w2 * v["stiffening"]
        hanging, sideways = w2 * v["hanging"], w2 * v["sideways"]
        has_gravity = bool(np.any(hanging) or np.any(sideways))
        has_more = bool(np.any(drag) or np.any(cubic))
        q = qd = memory = np.zeros(pressure.shape[1])
        out = [q]
        for n, h in enumerate(steps.tolist()):
            stiffness = 0.5 * (softened[n] + softened[n + 1])
            damping = 0.5 * (damped[n] + damped[n + 1])
            if has_more:
                stiffness = np.maximum(stiffness + cubic * q * q, LEAST * w2)
                damping = damping + drag * np.abs(qd)
            force = 0.5 * (moment[n] + moment[n + 1]) + stiffness * held * memory
            if has_gravity:
                force = force - hanging * np.sin(q) + sideways * (np.cos(q) - 1.0)
            new = qd * (1.0 - 0.5 * h * damping - 0.25 * h * h * stiffness)
            new = (new + h * (force - stiffness * q)) / (
                1.0 + 0.5 * h * damping + 0.25 * h * h * stiffness
            )
            before, q, qd = q, q + 0.5 * h * (qd + new), new
            memory = 0.5 * (before + q) + (memory - 0.5 * (before + q)) * forgotten[n]
            out.append(q)
        return np.stack(out)

    def _markers(self, angle: Array) -> Array:
        """(K, T, channels) from angles (T, K)."""
        v, q = self.values, angle.T[..., None]
        get = {n: x[:, None, None] for n, x in v.items()}
        rest = rest_of(self.run)
        moving, fixed = rest[: self.layout.moving], rest[self.layout.moving :]
        a, b, c = self.layout.axes
        small = np.abs(q) < 1e-6
        safe = np.where(small, 1.0, q)
        sine = np.where(small, 1.0, np.sin(safe) / safe)
        versine = np.where(small, 0.5 * q, (1.0 - np.cos(safe)) / safe)
        along = get["length"] * (sine - 1.0) + get["neutral_axis"] * q
        away = get["length"] * 2.0 * get["shape"] * versine
        way = get["direction"] + get["direction_drift"] * q
        offset = moving - moving.mean(axis=0) if len(moving) > 1 else np.zeros_like(moving)
        # the center of the face is not the markers' mean; both move with the rigid face
        o_a, o_b, o_c = (offset[:, i] for i in (a, b, c))
        turn = get["twist"] * q
        o_b, o_c = o_b * np.cos(turn) - o_c * np.sin(turn), o_b * np.sin(turn) + o_c * np.cos(turn)
        toward = o_b * np.cos(way) + o_c * np.sin(way) + get["center_toward"]
        beside = -o_b * np.sin(way) + o_c * np.cos(way)
        d_a = along + o_a * (np.cos(q) - 1.0) - toward * np.sin(q)
        d_t = away + o_a * np.sin(q) + toward * np.cos(q) - get["center_toward"]
        d_b = d_t * np.cos(way) - beside * np.sin(way) - offset[:, b]
        d_c = d_t * np.sin(way) + beside * np.cos(way) - offset[:, c]
        d_a, d_b, d_c = (
            d_a - get["frame_along"] * d_b - get["frame_across"] * d_c,
            d_b + get["frame_along"] * d_a,
            d_c + get["frame_across"] * d_a,
        )
        moved = np.zeros((*q.shape[:2], len(moving), 3))
        for index, shift in ((a, d_a), (b, d_b), (c, d_c)):
            moved[..., index] = moving[:, index] + (1.0 + get["scale"]) * shift
        held = np.broadcast_to(fixed, (*q.shape[:2], *fixed.shape))
        return np.concatenate([moved, held], axis=2).reshape(*q.shape[:2], -1)


def bending_scene(
    values: Mapping[str, Tensor],
    run: Run,
    layout: Layout,
    arc: Mapping[str, float],
    step: float = STEP,
) -> BendingScene:
    """Make the scene of a run.

    Args:
        values: Base parameters, nuisances of runs as "name@run"; they win over the arc's.
        run: Recorded run that has the command ``layout.command``.
        layout: Axes and command of the set-up.
        arc: "length", "shape", "direction", "neutral_axis", "center_toward" [m, rad].
        step: Time step of the integrator [s].
    """
    single = values["frequency"].ndim == 0
    arrays = {n: np.atleast_1d(v.detach().numpy()) for n, v in values.items()}
    own = {n.split("@")[0]: v for n, v in arrays.items() if n.endswith(f"@{run.name}")}
    shape = arrays["frequency"].shape
    plain = {n: np.full(shape, x) for n, x in {**PLAIN, **arc}.items()}
    return BendingScene({**plain, **arrays, **own}, run, layout, step, single)


def rest_of(run: Run) -> Array:
    """(markers, 3) mean places before the step [m]."""
    command = next(iter(run.command.values()))
    first = int(np.flatnonzero(command > 0.0)[0])
    before = run.measured[: max(first - 2, 1)]
    return np.asarray(np.nanmean(before, axis=0).reshape(-1, 3))
