"""Model, runs and noise as one least-squares problem in standardized coordinates.

Coordinates x: first the base parameters, then the components of the effects. All have the prior
N(0, 1); a component has the size 1.5 typical u(x) with the heavy-tailed u of ``sizes``, and x >= 0
unless the effect is signed. Records are nearly linear in base parameters and u: differences are
taken along these, the scaled coordinates.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import Array
from diffsim.core.check import LARGEST
from diffsim.core.checked import checked_methods
from diffsim.core.errors import DiffsimError
from diffsim.core.memo import Memo, memo_field
from diffsim.core.numbers import anywhere
from diffsim.data.study import Run
from diffsim.identify.correction import Correction
from diffsim.identify.effect import (
    PRIOR_WIDTH,
    Effect,
    coordinate_of,
    effect_coordinates,
    scaled_at,
    stretch_at,
    touches,
)
from diffsim.identify.jacobian import Jacobian, Stencil, difference_points, differences
from diffsim.identify.line import DifferenceLine, ModelPoint
from diffsim.identify.model import TOGETHER, RunPoints, SimModel, has_tangents
from diffsim.identify.numerics import Numerics
from diffsim.identify.shape import MovingShape
from diffsim.identify.whitening import WhitenedRuns, Whitener

SECANT = 0.1  # of the typical size
AT_ONCE = 1 << 22  # samples that are simulated at once: states beside them take some 200 MB
LANES = 32  # a batch has a multiple of that many members: kernels take eight at once
BACKWARD = 4  # directions of a batch, that a backward pass costs


class PredictionError(DiffsimError):
    """A simulation left the range of numbers."""


@checked_methods
class Coordinates:
    """Standardized coordinates of base parameters, then of the components of effects."""

    model: SimModel
    effects: tuple[Effect, ...]

    @property
    def num_base(self) -> int:
        """Number of base parameters."""
        return len(self.model.base)

    @property
    def owners(self) -> list[tuple[Effect, str]]:
        """Effect and component of every coordinate after the base parameters."""
        return [(e, c) for e in self.effects for c in e.components]

    @property
    def _effect_of_each(self) -> list[Effect | None]:
        """Effect of every coordinate; None of base parameters."""
        return [*(None for _ in self.model.base), *(e for e, _ in self.owners)]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates; components of vector effects as "wind.x"."""
        return (*(p.name for p in self.model.base), *effect_coordinates(self.effects))

    def columns_of(self, effect: Effect) -> list[int]:
        """Indices of the coordinates of an effect."""
        return [self.num_base + i for i, (e, _) in enumerate(self.owners) if e is effect]

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the coordinates, (n,) each."""
        base, owners = self.model.values, self.owners
        low = [-np.inf if e.signed else 0.0 for e, _ in owners]
        return (
            np.concatenate([base.low, low]),
            np.concatenate([base.high, np.full(len(owners), np.inf)]),
        )

    def scaled(self, x: Array) -> Array:
        """Scaled coordinates: sizes in units of ``PRIOR_WIDTH`` typical ones, (n,)."""
        n = self.num_base
        return np.concatenate([x[:n], scaled_at(x[n:])])

    def standardized(self, scaled: Array) -> Array:
        """Standardized coordinates of scaled ones, the inverse of ``scaled``, (n,)."""
        n = self.num_base
        return np.concatenate([scaled[:n], coordinate_of(scaled[n:])])

    def stretch(self, x: Array) -> Array:
        """Derivative of the scaled coordinates by the standardized ones, (n,)."""
        n = self.num_base
        return np.concatenate([np.ones(n), stretch_at(x[n:])])

    @property
    def size_units(self) -> Array:
        """Size of each component at the scaled coordinate one, (num_components,) [unit]."""
        return np.array([PRIOR_WIDTH * e.typical for e, _ in self.owners])

    def sizes_at(self, x: Tensor) -> dict[Effect, Tensor]:
        """Sizes [unit] of the effects at standardized coordinates."""
        return self.sizes_of(scaled_at(x[..., self.num_base :]))

    def sizes_of(self, scaled: Tensor) -> dict[Effect, Tensor]:
        """Sizes [unit] of the effects from their own scaled coordinates."""
        sizes, k = {}, 0
        for effect in self.effects:
            count = len(effect.components)
            sizes[effect] = PRIOR_WIDTH * effect.typical * scaled[..., k : k + count]
            k += count
        return sizes


@checked_methods
@dataclass(frozen=True, eq=False)
class Problem(Coordinates, WhitenedRuns):
    """Residuals r = W (y - S(x)) of several runs and their derivatives.

    Attributes:
        model: Simulator with base parameters.
        runs: Recorded runs that are compared with the simulation.
        whitener: Transformation that makes the noise of a run white with standard deviation one.
        effects: Effects whose components are coordinates after the base parameters.
        jacobian: Method and step of the derivatives.
        numerics: Factors on the numerical settings; the model's own settings if None.
        workers: Threads over runs; the compiled kernels release the interpreter.
        correction: What finer settings than ``numerics`` change, told at one point; None: nothing.
        memo: What was computed of this problem and is asked for again.
    """

    model: SimModel
    runs: tuple[Run, ...]
    whitener: Whitener
    effects: tuple[Effect, ...] = ()
    jacobian: Jacobian = field(default_factory=Jacobian)
    numerics: Numerics | None = None
    workers: int = 1
    correction: Correction | None = None
    memo: Memo[Any] = memo_field(256)  # records are large

    @property
    def reference_numerics(self) -> Numerics | None:
        """Numerical settings that the records stand for: those of the simulations, or the finer
        ones that these are corrected by; None: the model's own."""
        return self.numerics if self.correction is None else self.correction.finest

    def _require_finite(self, run: Run, q: Tensor, sizes: Mapping[Effect, Tensor]) -> None:
        """A step out of the range of numbers is a failed step, whatever the simulator says to it.

        Raises:
            PredictionError: values of base parameters or sizes that are no numbers, or too large.
        """
        parts = [self.model.values.raw(q), *sizes.values()]
        if not anywhere(~(torch.cat([p.reshape(-1) for p in parts]).abs() <= LARGEST)):
            return
        values = self.model.values.at(q)
        every = {**values, **{effect.name: size for effect, size in sizes.items()}}
        bad = [name for name, value in every.items() if anywhere(~(value.abs() <= LARGEST))]
        if bad:
            raise PredictionError(f"run {run.name}: {', '.join(bad)} left the range of numbers")

    def predict(self, run: Run, x: Tensor) -> Tensor:
        """Predicted channels, (num_samples, num_channels)."""
        sizes = self.sizes_at(x)
        self._require_finite(run, x[: self.num_base], sizes)
        out = self.model.predict(run, self._simulated_at(x), sizes, self.numerics)
        return self._complete_prediction(run, out, run.measured.shape)

    def shape_at(self, run: Run, x: Tensor) -> MovingShape | None:
        """What moves in the run as it is simulated; None where models show nothing."""
        q, sizes = self._simulated_at(x), self.sizes_at(x)
        return self.model.shape_at(run, q, sizes, self.numerics)

    def _simulated_at(self, x: Tensor) -> Tensor:
        """Standardized base parameters of the simulations, (..., num_base)."""
        q = x[..., : self.num_base]
        return q if self.correction is None else q + self.correction.shift

    def _complete_prediction(
        self, run: Run, out: Tensor, shape: tuple[int, ...], *, is_slope: bool = False
    ) -> Tensor:
        """What the model predicts of a run, if it has the shape asked for, with the correction,
        which slopes have none of."""
        if tuple(out.shape) != shape:
            raise ValueError(
                f"model {self.model.name} predicts {tuple(out.shape)} for run {run.name}, "
                f"expected {shape}: samples and channels of its ``measured``"
            )
        return out if self.correction is None or is_slope else out + self.correction.of(run)

    def predict_many(self, run: Run, points: Sequence[Tensor]) -> Tensor:
        """(K, num_samples, num_channels) at K points."""
        x = torch.stack(list(points))
        asked = RunPoints(run, self._simulated_at(x), self.sizes_at(x))
        return self._predict_each([asked])[0]

    def _predict_each(self, asked: Sequence[RunPoints]) -> list[Tensor]:
        """Predictions of runs at a point or many, as many at once as room allows."""
        counts = [1 if a.q.ndim == 1 else len(a.q) for a in asked]
        needed = sum(n * a.run.measured.size for n, a in zip(counts, asked, strict=True))
        if needed > AT_ONCE and len(asked) > 1:
            middle = len(asked) // 2
            return self._predict_each(asked[:middle]) + self._predict_each(asked[middle:])
        if needed > AT_ONCE and counts[0] > LANES:
            run, q, sizes = asked[0]
            middle = LANES * max(counts[0] // (2 * LANES), 1)
            halves = [
                RunPoints(run, q[half], {effect: size[half] for effect, size in sizes.items()})
                for half in (slice(middle), slice(middle, None))
            ]
            return [torch.cat([self._predict_each([half])[0] for half in halves])]
        for a in asked:
            if a.q.ndim > 1:
                self._require_finite(*a)
        found = zip(asked, self.model.predict_each(asked, self.numerics), strict=True)
        return [
            self._complete_prediction(a.run, out, (*a.q.shape[:-1], *a.run.measured.shape))
            for a, out in found
        ]

    def _points_of(self, run: Run, scaled: Tensor) -> RunPoints:
        """A run at K points in scaled coordinates, (K, n)."""
        sizes = self.sizes_of(scaled[:, self.num_base :])
        return RunPoints(run, self._simulated_at(scaled), sizes)

    def record(self, x: Array) -> Array:
        """Predicted samples of all runs at x, (N,) [unit of the channel].

        Raises:
            PredictionError: samples that are no numbers.
        """
        point = torch.from_numpy(np.ascontiguousarray(x))
        with torch.no_grad():  # what is the same for all runs is made once
            q, sizes = self._simulated_at(point), self.sizes_at(point)
            for first in self.runs[:1]:
                self._require_finite(first, point[: self.num_base], sizes)

        found = self._predict_all([RunPoints(run, q, sizes) for run in self.runs])
        given = zip(self.runs, found, strict=True)
        return np.concatenate([_finite(run, out.numpy()) for run, out in given])

    def residual(self, x: Array) -> Array:
        """(num_valid,) whitened residual of all runs."""
        return self.residual_of(self.record(x))

    def cost(self) -> float:
        """Weighted steps of one simulation of all runs."""
        return sum(self.model.cost(run, self.numerics) for run in self.runs)

    def cost_of_table(self, more: float = 0.0, *, each: float | None = None) -> float:
        """Weighted steps of simulations along all coordinates that move a run, and of one more.

        Args:
            more: Further points of all runs.
            each: Whole simulations along each coordinate; None: one, in a batch where there are.
        """
        there = {name for e in self.effects for name in e.shapes}
        idle = {p.name for p in self.model.base if p.of_effect} - there
        moving = [name for name in self.names if name not in idle]
        times = (TOGETHER if self.model.batched else 1.0) if each is None else each
        return sum(
            self.model.cost(run, self.numerics)
            * (1.0 + times * (more + sum(touches(name, run) for name in moving)))
            for run in self.runs
        )

    def records(self, points: Array) -> Array:
        """Predicted samples of all runs at K points, (K, N) [unit of the channel].

        Args:
            points: Standardized coordinates, (K, n).
        """
        x = torch.from_numpy(np.array(points))
        q, sizes = self._simulated_at(x), self.sizes_at(x)
        found = self._predict_all([RunPoints(run, q, sizes) for run in self.runs])
        return np.concatenate([out.numpy().reshape(len(x), -1) for out in found], axis=1)

    def linearize(
        self, x: Array, *, screen: bool = False, only: Sequence[int] | None = None
    ) -> tuple[Array, Array]:
        """Residual and A = d(W S)/dx at x.

        Args:
            x: Standardized coordinates, (n,).
            screen: Non-smooth effects by their secant from here to a tenth of the typical size.
            only: Coordinates to differentiate, in this order, each once; all if None.

        Returns:
            (num_valid,) and (num_valid, len(only)).
        """
        residual, slopes = self.linearize_scaled(x, screen=screen, only=only)
        stretch = self.stretch(x)
        slopes *= stretch if only is None else stretch[list(dict.fromkeys(only))]
        return residual, slopes

    def linearize_scaled(
        self, x: Array, *, screen: bool = False, only: Sequence[int] | None = None
    ) -> tuple[Array, Array]:
        """Residual and d(W S)/du at x, by the scaled coordinates u; arguments of ``linearize``."""
        record, columns = self.linearize_record(x, screen=screen, only=only)
        return self.residual_of(record), self.whiten_all(columns)

    def linearize_record(
        self, x: Array, *, screen: bool = False, only: Sequence[int] | None = None
    ) -> tuple[Array, Array]:
        """Predicted samples of all runs and dS/du at x; arguments of ``linearize``.

        Returns:
            (N,) and (N, len(only)) [unit of the channel].
        """
        point = torch.from_numpy(np.ascontiguousarray(self.scaled(x), dtype=np.float64))
        names, there = self.names, {name for e in self.effects for name in e.shapes}
        idle = {p.name for p in self.model.base if p.of_effect} - there  # shapes of no effect
        asked = range(len(x)) if only is None else dict.fromkeys(only)
        place = {i: k for k, i in enumerate(asked)}
        wanted = [i for i in sorted(place) if names[i] not in idle]
        stencils = self._choose_stencils(x, wanted, screen)
        effects = self._effect_of_each
        quick = {i for i in stencils if (e := effects[i]) is None or e.smooth}
        edges = np.cumsum([run.measured.size for run in self.runs])
        slopes = np.zeros((edges[-1], len(place)))
        parts = zip(self.runs, np.split(slopes, edges[:-1]), strict=True)
        of_run = {run.name: part for run, part in parts}

        own = {
            run.name: {i: s for i, s in stencils.items() if touches(names[i], run)}
            for run in self.runs
        }

        def one(run: Run) -> tuple[Array, Array]:
            return self.jacobian.columns(
                lambda points: self._predict_each(
                    [self._points_of(run, torch.stack(list(points)))]
                )[0],
                point,
                own[run.name],
                quick=quick.intersection(own[run.name]),
                tangents=lambda stencils: self._tangents(run, point, stencils),
            )

        if self.model.joins_runs and self.jacobian.method != "forward_mode":
            points = [difference_points(point, own[run.name]) for run in self.runs]
            rows = self._predict_all([*map(self._points_of, self.runs, points)])
            columns_of = [
                differences(found.numpy(), own[run.name])
                for run, found in zip(self.runs, rows, strict=True)
            ]
        else:
            columns_of = self._compute_each(one, self.runs)
        record = []
        for run, (here, columns) in zip(self.runs, columns_of, strict=True):
            of_run[run.name][:, [place[i] for i in own[run.name]]] = columns
            record.append(_finite(run, here))
        return np.concatenate(record), slopes

    def _choose_stencils(self, x: Array, idx: Sequence[int], screen: bool) -> dict[int, Stencil]:
        """Difference formulas along scaled coordinates, inward at bounds."""
        u, steps = self.scaled(x).tolist(), self.stretch(x) * self.step_factors
        steps = (self.jacobian.step * steps).tolist()
        low, high = self.bounds  # of sizes they are zero or infinite: the same in both coordinates
        effects, out = self._effect_of_each, {}
        for i in idx:
            effect = effects[i]
            if screen and effect is not None and not effect.smooth:
                out[i] = Stencil.chord(SECANT / PRIOR_WIDTH)
            elif u[i] - steps[i] < low[i]:
                out[i] = Stencil.one_sided(steps[i])
            elif u[i] + steps[i] > high[i]:
                out[i] = Stencil.one_sided(-steps[i])
            else:
                out[i] = Stencil.central(steps[i])
        return out

    @property
    def step_factors(self) -> Array:
        """Factors on steps along the coordinates: below 1 where a parameter asks for it, (n,)."""
        own = [
            1.0 if p.log else min(1.0, p.step / (p.sd * self.jacobian.step))
            for p in self.model.base
        ]
        return np.array(own + [1.0] * len(self.owners))

    def _tangents(
        self, run: Run, at: Tensor, stencils: Mapping[int, Stencil]
    ) -> tuple[Array, Array] | None:
        """Prediction and columns by the model's own tangents; None where it has none."""
        if not has_tangents(self.model):
            return None
        with torch.no_grad():
            given = self.model.tangents(
                run,
                self._point(at),
                [self._line(at, i, stencil) for i, stencil in stencils.items()],
                self.numerics,
            )
        if given is None:
            return None
        self.model.note_derivatives(run, len(stencils), self.numerics)
        here, columns = given
        shape = run.measured.shape
        columns = self._complete_prediction(run, columns, (len(stencils), *shape), is_slope=True)
        here = self._complete_prediction(run, here, shape)
        return here.numpy().ravel(), columns.reshape(len(stencils), -1).numpy().T

    def _point(self, scaled: Tensor) -> ModelPoint:
        return ModelPoint(self._simulated_at(scaled), self.sizes_of(scaled[self.num_base :]))

    def _line(self, at: Tensor, i: int, stencil: Stencil) -> DifferenceLine:
        """Points of a stencil along scaled coordinate i."""
        unit = torch.zeros_like(at)
        unit[i] = 1.0
        points = tuple(self._point(at + offset * unit) for offset in stencil.offsets)
        return DifferenceLine(stencil, points, self._effect_of_each[i])

    def gradient(self, x: Array) -> tuple[float, Array]:
        """½ |r|² and its gradient by reverse mode: one backward pass per run."""

        def one(run: Run, predicted: Array) -> tuple[float, Array]:
            matrix = self.whitener.matrix(run)
            r = matrix @ (np.nan_to_num(run.measured).ravel() - predicted)
            return 0.5 * float(r @ r), -(matrix.T @ r)

        return self._pull_back(x, one)

    def pullback(self, x: Array, cotangent: Array) -> Array:
        """A'c by reverse mode, A = d(W S)/dx, (n,): one backward pass per run.

        Args:
            x: Standardized coordinates, (n,).
            cotangent: c in whitened samples of all runs, (num_valid,).
        """
        of_run = {r.name: c for r, c in zip(self.runs, self.by_run(cotangent), strict=True)}

        def one(run: Run, predicted: Array) -> tuple[float, Array]:
            self.model.note_derivatives(run, BACKWARD, self.numerics)
            return 0.0, self.whitener.matrix(run).T @ of_run[run.name]

        return self._pull_back(x, one)[1]

    def _pull_back(
        self, x: Array, cost: Callable[[Run, Array], tuple[float, Array]]
    ) -> tuple[float, Array]:
        """Sum over runs of a cost and of its gradient; ``cost`` gives that by the predicted samples
        of a run, (num_samples * num_channels,)."""
        leaf = torch.tensor(x, dtype=torch.float64, requires_grad=True)

        def one(run: Run) -> tuple[float, Array]:
            predicted = self.predict(run, leaf)
            value, slope = cost(run, predicted.detach().numpy().ravel())
            given = torch.from_numpy(np.ascontiguousarray(slope)).view_as(predicted)
            # of a product: a cotangent as argument makes torch import sympy, 0.6 CPU seconds
            (grad,) = torch.autograd.grad((predicted * given).sum(), leaf)
            return value, np.asarray(grad.numpy())

        parts = self._compute_each(one, self.runs)
        return sum(p[0] for p in parts), np.asarray(np.sum([p[1] for p in parts], axis=0))

    def _predict_all(self, asked: Sequence[RunPoints]) -> list[Tensor]:
        """Predictions as of ``_predict_each`` without gradients, in a part for each worker."""
        predict = torch.no_grad()(self._predict_each)
        size = -(-len(asked) // self.workers) if self.model.joins_runs else 1
        parts = [asked[k : k + size] for k in range(0, len(asked), size or 1)]
        return [out for part in self._compute_each(predict, parts) for out in part]

    def _compute_each(self, job: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
        if self.workers > 1:
            with ThreadPoolExecutor(self.workers) as pool:
                contexts = [copy_context() for _ in items]  # records of solves go along
                return list(pool.map(lambda c, item: c.run(job, item), contexts, items))
        return [job(item) for item in items]


def _finite(run: Run, predicted: Array) -> Array:
    """Predicted samples, (num_samples * num_channels,).

    Raises:
        PredictionError: samples that are no numbers.
    """
    flat = np.asarray(predicted).ravel()
    if not np.isfinite(flat).all():
        bad = int((~np.isfinite(flat)).sum())
        raise PredictionError(
            f"the prediction of run {run.name} has {bad} NaN or infinite entries; narrow the "
            "priors or bounds of the parameters, shorten the time step, or mend the scene"
        )
    return flat
