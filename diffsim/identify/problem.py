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
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

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
from diffsim.identify.jacobian import Jacobian, Stencil
from diffsim.identify.line import DifferenceLine, ModelPoint
from diffsim.identify.model import SimModel, has_tangents
from diffsim.identify.numerics import Numerics
from diffsim.identify.shape import MovingShape
from diffsim.identify.whitening import Whitener

Array = NDArray[np.float64]
SECANT = 0.1  # of the typical size
_MOST_KEPT = 256
AT_ONCE = 1 << 22  # samples that are simulated at once: states beside them take some 200 MB
LANES = 32  # a batch has a multiple of that many members: kernels take eight at once
BACKWARD = 4  # directions of a batch, that a backward pass costs


class PredictionError(DiffsimError):
    """A simulation left the range of numbers."""


@dataclass(frozen=True, eq=False)
class Problem:
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
    memo: Memo[Any] = memo_field(_MOST_KEPT)

    @property
    def stands_for(self) -> Numerics | None:
        """Numerical settings that the records stand for: those of the simulations, or the finer
        ones that these are corrected by; None: the model's own."""
        return self.numerics if self.correction is None else self.correction.finest

    @property
    def num_base(self) -> int:
        """Number of base parameters."""
        return len(self.model.base)

    @property
    def owners(self) -> list[tuple[Effect, str]]:
        """Effect and component of every coordinate after the base parameters."""
        return [(e, c) for e in self.effects for c in e.components]

    @property
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

    def coordinates_of(self, sizes: Mapping[str, float]) -> Array:
        """Standardized coordinates of sizes, the inverse of ``sizes_at``, (num_components,).

        Args:
            sizes: Size by name of the component ("wind.x") [unit]; zero for those not given.
        """
        given = [sizes.get(name, 0.0) for name in effect_coordinates(self.effects)]
        return coordinate_of(np.array(given) / self.size_units)

    def sizes_at(self, x: Tensor) -> dict[Effect, Tensor]:
        """Sizes [unit] of the effects at standardized coordinates."""
        return self._sizes(scaled_at(x[..., self.num_base :]))

    def _sizes(self, scaled: Tensor) -> dict[Effect, Tensor]:
        """Sizes [unit] of the effects from their scaled coordinates."""
        sizes, k = {}, 0
        for effect in self.effects:
            count = len(effect.components)
            sizes[effect] = PRIOR_WIDTH * effect.typical * scaled[..., k : k + count]
            k += count
        return sizes

    def _require_finite(self, run: Run, q: Tensor, sizes: Mapping[Effect, Tensor]) -> None:
        """A step out of the range of numbers is a failed step, whatever the simulator says to it.

        Raises:
            PredictionError: values of base parameters or sizes that are not finite.
        """
        parts = [self.model.values.raw(q), *sizes.values()]
        if not anywhere(~torch.isfinite(torch.cat([p.reshape(-1) for p in parts]))):
            return
        values = self.model.values.at(q)
        every = {**values, **{effect.name: size for effect, size in sizes.items()}}
        bad = [name for name, value in every.items() if anywhere(~torch.isfinite(value))]
        if bad:
            raise PredictionError(f"run {run.name}: {', '.join(bad)} left the range of numbers")

    def predict(self, run: Run, x: Tensor) -> Tensor:
        """Predicted channels, (num_samples, num_channels)."""
        sizes = self.sizes_at(x)
        self._require_finite(run, x[: self.num_base], sizes)
        out = self.model.predict(run, self._simulated_at(x), sizes, self.numerics)
        return self._add_correction(run, self._of_shape(run, out, run.measured.shape))

    def shape_at(self, run: Run, x: Tensor) -> MovingShape | None:
        """What moves in the run as it is simulated; None where models show nothing."""
        q, sizes = self._simulated_at(x), self.sizes_at(x)
        return self.model.shape_at(run, q, sizes, self.numerics)

    def _simulated_at(self, x: Tensor) -> Tensor:
        """Standardized base parameters of the simulations, (..., num_base)."""
        q = x[..., : self.num_base]
        return q if self.correction is None else q + self.correction.shift

    def _add_correction(self, run: Run, out: Tensor) -> Tensor:
        return out if self.correction is None else out + self.correction.of(run)

    def predict_many(self, run: Run, points: Sequence[Tensor]) -> Tensor:
        """(K, num_samples, num_channels) at K points."""
        x = torch.stack(list(points))
        return self._predict_many(run, self._simulated_at(x), self.sizes_at(x))

    def _predict_scaled(self, run: Run, points: Sequence[Tensor]) -> Tensor:
        """(K, num_samples, num_channels) at K points in scaled coordinates."""
        u = torch.stack(list(points))
        return self._predict_many(run, self._simulated_at(u), self._sizes(u[:, self.num_base :]))

    def _predict_many(self, run: Run, q: Tensor, sizes: Mapping[Effect, Tensor]) -> Tensor:
        self._require_finite(run, q, sizes)
        parts = max(AT_ONCE // (LANES * max(run.measured.size, 1)), 1)
        at_once = LANES * parts
        each = [
            self.model.predict_many(
                run,
                q[k : k + at_once],
                {effect: size[k : k + at_once] for effect, size in sizes.items()},
                self.numerics,
            )
            for k in range(0, max(len(q), 1), at_once)
        ]
        out = each[0] if len(each) == 1 else torch.cat(each)
        return self._add_correction(run, self._of_shape(run, out, (len(q), *run.measured.shape)))

    def _of_shape(self, run: Run, out: Tensor, shape: tuple[int, ...]) -> Tensor:
        if tuple(out.shape) != shape:
            raise ValueError(
                f"model {self.model.name} predicts {tuple(out.shape)} for run {run.name}, "
                f"expected {shape}: samples and channels of its ``measured``"
            )
        return out

    def residual(self, x: Array) -> Array:
        """(num_valid,) whitened residual of all runs."""
        point = torch.from_numpy(np.ascontiguousarray(x))

        def one(run: Run) -> Array:
            with torch.no_grad():
                predicted = self.predict(run, point).numpy()
            return self.whiten(
                run, np.nan_to_num(run.measured).ravel() - _check_finite(predicted, run)
            )

        return np.concatenate(self._compute_each(one))

    def cost(self) -> float:
        """Weighted steps of one simulation of all runs."""
        return sum(self.model.cost(run, self.numerics) for run in self.runs)

    def records(self, points: Array) -> Array:
        """Predicted samples of all runs at K points, (K, N) [unit of the channel].

        Args:
            points: Standardized coordinates, (K, n).
        """
        given = [torch.from_numpy(np.array(x)) for x in points]

        def one(run: Run) -> Array:
            with torch.no_grad():
                return self.predict_many(run, given).numpy().reshape(len(given), -1)

        return np.concatenate(self._compute_each(one), axis=1)

    def linearize(
        self, x: Array, *, screen: bool = False, only: Sequence[int] | None = None
    ) -> tuple[Array, Array]:
        """Residual and A = d(W S)/dx at x.

        Args:
            x: Standardized coordinates, (n,).
            screen: Non-smooth effects by their secant from here to a tenth of the typical size.
            only: Coordinates to differentiate; the other columns are zero.

        Returns:
            (num_valid,) and (num_valid, n).
        """
        residual, slopes = self.linearize_scaled(x, screen=screen, only=only)
        return residual, slopes * self.stretch(x)

    def linearize_scaled(
        self, x: Array, *, screen: bool = False, only: Sequence[int] | None = None
    ) -> tuple[Array, Array]:
        """Residual and d(W S)/du at x, by the scaled coordinates u; arguments of ``linearize``."""
        stretch = self.stretch(x)
        u = self.scaled(x)
        point = torch.from_numpy(np.ascontiguousarray(u, dtype=np.float64))
        # bounds of sizes are zero or infinite: the same in both coordinates
        low, high = self.bounds
        steps = stretch * self.step_factors
        step = self.jacobian.step * steps
        below, above = u - step < low, u + step > high
        inward = [int(below[i]) or -int(above[i]) for i in range(len(x))]
        secant = [0.0] * self.num_base + [
            SECANT / PRIOR_WIDTH if screen and not e.smooth else 0.0 for e, _ in self.owners
        ]
        smooth = [True] * self.num_base + [e.smooth for e, _ in self.owners]
        names = self.names
        wanted = range(len(x)) if only is None else sorted(set(only))
        idle = self._list_idle()

        def one(run: Run) -> tuple[Array, Array]:
            idx = [i for i in wanted if touches(names[i], run) and names[i] not in idle]
            here, columns = self.jacobian.columns(
                lambda points: self._predict_scaled(run, points),
                point,
                idx,
                inward=inward,
                secant=secant,
                smooth=smooth,
                stretch=steps.tolist(),
                tangents=lambda stencils: self._tangents(run, point, stencils),
            )
            matrix = self.whitener.matrix(run)
            full = np.zeros((matrix.shape[0], len(x)))
            full[:, idx] = matrix @ columns
            left = np.nan_to_num(run.measured).ravel() - _check_finite(here, run)
            return np.asarray(matrix @ left), full

        parts = self._compute_each(one)
        return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])

    def _list_idle(self) -> set[str]:
        """Base parameters that are shapes of effects which are not there: nothing depends on
        them."""
        there = {name for e in self.effects for name in e.shapes}
        return {p.name for p in self.model.base if p.of_effect} - there

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
        columns = self._of_shape(run, columns, (len(stencils), *shape))
        here = self._add_correction(run, self._of_shape(run, here, shape))
        return here.numpy().ravel(), columns.reshape(len(stencils), -1).numpy().T

    def _point(self, scaled: Tensor) -> ModelPoint:
        return ModelPoint(self._simulated_at(scaled), self._sizes(scaled[self.num_base :]))

    def _line(self, at: Tensor, i: int, stencil: Stencil) -> DifferenceLine:
        """Points of a stencil along scaled coordinate i."""
        unit = torch.zeros_like(at)
        unit[i] = 1.0
        owner = None if i < self.num_base else self.owners[i - self.num_base][0]
        points = tuple(self._point(at + offset * unit) for offset in stencil.offsets)
        return DifferenceLine(stencil, points, owner)

    def gradient(self, x: Array) -> tuple[float, Array]:
        """½ |r|² and its gradient by reverse mode: one backward pass per run."""
        leaf = torch.tensor(x, dtype=torch.float64, requires_grad=True)

        def one(run: Run) -> tuple[float, Array]:
            predicted, matrix = self.predict(run, leaf), self.whitener.matrix(run)
            left = np.nan_to_num(run.measured).ravel() - predicted.detach().numpy().ravel()
            r = matrix @ left
            return 0.5 * float(r @ r), _pulled_back(predicted, leaf, -(matrix.T @ r))

        parts = self._compute_each(one)
        return sum(p[0] for p in parts), np.sum([p[1] for p in parts], axis=0)

    def pullback(self, x: Array, cotangent: Array) -> Array:
        """A'c by reverse mode, A = d(W S)/dx, (n,): one backward pass per run.

        Args:
            x: Standardized coordinates, (n,).
            cotangent: c in whitened samples of all runs, (num_valid,).
        """
        leaf = torch.tensor(x, dtype=torch.float64, requires_grad=True)
        parts = self.by_run(cotangent)
        of_run = {run.name: part for run, part in zip(self.runs, parts, strict=True)}

        def one(run: Run) -> Array:
            matrix = self.whitener.matrix(run)
            self.model.note_derivatives(run, BACKWARD, self.numerics)
            return _pulled_back(self.predict(run, leaf), leaf, matrix.T @ of_run[run.name])

        return np.asarray(np.sum(self._compute_each(one), axis=0))

    @property
    def num_valid(self) -> list[int]:
        """Measured samples of each run, all channels together."""
        return [int(np.isfinite(run.measured).sum()) for run in self.runs]

    def by_run(self, rows: Array) -> list[Array]:
        """Whitened rows of all runs, (num_valid, ...), by run."""
        counts = self.num_valid
        return np.split(rows, np.cumsum(counts)[:-1])

    def on_grid(self, run: Run, rows: Array) -> Array:
        """(num_samples, num_channels) of whitened rows of a run, (num_valid,): each stands at its
        newest sample, the largest column that it uses; 0 where nothing was measured."""
        matrix = self.whitener.matrix(run)
        grid = np.zeros(run.measured.size)
        grid[np.maximum.reduceat(matrix.indices, matrix.indptr[:-1])] = rows
        return grid.reshape(run.measured.shape)

    def whiten(self, run: Run, record: Array) -> Array:
        """(num_valid, ...) of a flattened record (num_samples * num_channels, ...)."""
        return np.asarray(self.whitener.matrix(run) @ record)

    def _compute_each(self, job: Callable[[Run], Any]) -> list[Any]:
        if self.workers > 1:
            with ThreadPoolExecutor(self.workers) as pool:
                contexts = [copy_context() for _ in self.runs]  # records of solves go along
                return list(pool.map(lambda c, run: c.run(job, run), contexts, self.runs))
        return [job(run) for run in self.runs]


def _pulled_back(predicted: Tensor, leaf: Tensor, cotangent: Array) -> Array:
    given = torch.from_numpy(np.ascontiguousarray(cotangent)).view_as(predicted)
    (grad,) = torch.autograd.grad(predicted, leaf, given)
    return np.asarray(grad.numpy())


def _check_finite(predicted: Array, run: Run) -> Array:
    flat = np.asarray(predicted).ravel()
    if not np.isfinite(flat).all():
        bad = int((~np.isfinite(flat)).sum())
        raise PredictionError(
            f"the prediction of run {run.name} has {bad} NaN or infinite entries; narrow the "
            "priors or bounds of the parameters, shorten the time step, or mend the scene"
        )
    return flat
