"""The space that co-design searches: a parametric design, and its fast local copy for solvers."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from diffsim.copter.codesign.polynomial import RTOL, Polynomial, fit
from diffsim.copter.codesign.polytope import closest_feasible, random_feasible
from diffsim.copter.design.design import Design
from diffsim.copter.vehicle.multicopter import Multicopter
from diffsim.core.arrays import Array


class DesignSpace(Protocol):
    """What co-design needs of a parametric multicopter.

    Attributes:
        names: Names of the shape parameters, num_params of them.
        values: Present values s, (num_params,).
        inequalities: A and b of the feasible set A s <= b, (num_rows, num_params) and (num_rows,)
            (thesis eq. 3.10).
    """

    @property
    def names(self) -> Sequence[str]: ...
    @property
    def values(self) -> Tensor: ...
    @property
    def inequalities(self) -> tuple[Tensor, Tensor]: ...

    def multicopter(
        self, s: Tensor, directions: Tensor | None = None, spins: Tensor | None = None
    ) -> Multicopter:
        """The multicopter of parameters s, differentiable in s and directions."""
        ...

    def cost(self, s: Tensor) -> Tensor:
        """Cost, ()."""
        ...

    def size(self, s: Tensor) -> Tensor:
        """Total length of rods, () [m] (thesis eq. 3.16)."""
        ...


@dataclass(frozen=True)
class Shape:
    """Values of one shape and their derivatives by the shape parameters, p = num_params.

    Attributes:
        mass, cost, size: [kg], [money], [m], with gradients (p,) in d_mass, d_cost, d_size.
        positions: Positions of the rotors relative to the center of mass, (n_rotors, 3) [m].
        d_positions: (n_rotors, 3, p).
    """

    mass: float
    cost: float
    size: float
    positions: Array
    d_mass: Array
    d_cost: Array
    d_size: Array
    d_positions: Array


class ShapeModel:
    """Mass, rotor positions, cost and size of a design as functions of s, with derivatives.

    Mass, mass times position, cost and size of parts that depend linearly on s are quadratics in
    s, those of free-form frames polynomials of a higher degree: they are sampled once and then
    cost microseconds. Any other design is differentiated by torch at every call, which is right
    but slow; ``is_polynomial`` tells which.

    Attributes:
        start: Parameters at which the model was made, (num_params,).
        A, b: The feasible set A s <= b.
        vehicle: The multicopter at the start, without gradients.
        length: Mean distance of the rotors from the center of mass at the start [m].
    """

    def __init__(
        self, design: DesignSpace, directions: Tensor | None = None, start: Array | None = None
    ):
        values = design.values.detach().double()
        self.start = values.numpy().copy() if start is None else np.array(start, float)
        A, b = design.inequalities
        self.A, self.b = A.detach().double().numpy().copy(), b.detach().double().numpy().copy()
        for name, array in (
            ("values", self.start),
            ("inequalities", self.A),
            ("inequalities", self.b),
        ):
            if not np.isfinite(array).all():
                raise ValueError(f"the design's {name} must be finite, got {array.tolist()}")
        # trial points of the solvers and samples of the quadratics may lie outside of the bounds
        self._design = replace(design, bounded=False) if isinstance(design, Design) else design
        self._directions = directions
        self.start = closest_feasible(self.A, self.b, self.start)
        self.vehicle = design.multicopter(torch.as_tensor(self.start), directions).detach()
        self.num_rotors = self.vehicle.num_rotors
        distance = self.vehicle.positions.norm(dim=-1)
        self.length = max(float(distance.mean()), 1e-3)
        rng = np.random.default_rng(0)

        def points() -> Iterator[Array]:
            while True:
                yield random_feasible(self.A, self.b, self.start, 2.0 * self.length, rng)

        quadratic = _Quadratic.sample(self._raw, self.start, self.length)
        probes = list(itertools.islice(points(), 3))
        self._fast: _Quadratic | Polynomial | None = quadratic
        if not all(quadratic.fits(self._raw, probe) for probe in probes):
            self._fast = fit(self._sample, points(), self.start, self.length)

    @property
    def is_polynomial(self) -> bool:
        """Whether shapes cost microseconds."""
        return self._fast is not None

    @property
    def num_params(self) -> int:
        """Number of shape parameters."""
        return len(self.start)

    def at(self, s: Array) -> Shape:
        """Values and first derivatives at s, (num_params,)."""
        y, dy = self._raw_jacobian(s)
        mass, d_mass = y[0], dy[0]
        positions = y[3:].reshape(-1, 3) / mass
        d_positions = (dy[3:].reshape(-1, 3, len(s)) - positions[..., None] * d_mass) / mass
        return Shape(
            mass=float(mass),
            cost=float(y[1]),
            size=float(y[2]),
            positions=positions,
            d_mass=d_mass,
            d_cost=dy[1],
            d_size=dy[2],
            d_positions=d_positions,
        )

    def hessian(
        self, s: Array, of_mass: float, of_cost: float, of_size: float, of_positions: Array
    ) -> Array:
        """Hessian by s of the weighted sum of mass, cost, size and positions, (p, p).

        positions r = q / m with q = m r a quadratic:
        r'' = (q'' - r m'' - r' (x) m' - m' (x) r') / m.
        """
        shape = self.at(s)
        of_q = of_positions / shape.mass
        of_m = of_mass - float((of_q * shape.positions).sum())
        weights = np.concatenate([[of_m, of_cost, of_size], of_q.ravel()])
        cross = np.outer(np.einsum("ic,icp->p", of_q, shape.d_positions), shape.d_mass)
        return self._raw_hessian(s, weights) - cross - cross.T

    def inertia(self, s: Array) -> tuple[Array, Array]:
        """About the center of mass, (3, 3) [kg m^2], and its derivative (3, 3, p)."""

        def of(x: Tensor) -> Tensor:
            return self._design.multicopter(x, self._directions).inertia

        point = torch.tensor(s, dtype=torch.float64)
        with torch.no_grad():
            value = of(point).numpy()
        return value, torch.autograd.functional.jacobian(of, point).numpy()

    def _raw(self, s: Tensor) -> Tensor:
        """Mass, cost, size and mass times positions, (3 + 3 n_rotors,)."""
        vehicle = self._design.multicopter(s, self._directions)
        scalars = [vehicle.mass, self._design.cost(s), self._design.size(s)]
        return torch.cat([torch.stack(scalars), (vehicle.mass * vehicle.positions).reshape(-1)])

    @torch.no_grad()
    def _sample(self, s: Array) -> Array:
        return self._raw(torch.tensor(s, dtype=torch.float64)).numpy().copy()

    def _raw_jacobian(self, s: Array) -> tuple[Array, Array]:
        if self._fast is not None:
            return self._fast.at(s)
        point = torch.tensor(s, dtype=torch.float64)
        jacobian = torch.autograd.functional.jacobian(self._raw, point)
        with torch.no_grad():
            return self._raw(point).numpy(), jacobian.numpy()

    def _raw_hessian(self, s: Array, weights: Array) -> Array:
        if self._fast is not None:
            return self._fast.hessian(s, weights)
        w = torch.tensor(weights, dtype=torch.float64)
        hessian = torch.autograd.functional.hessian(
            lambda x: w @ self._raw(x), torch.tensor(s, dtype=torch.float64)
        )
        return hessian.numpy()


@dataclass(frozen=True)
class _Quadratic:
    """y(s) = value + gradient (s - origin) + 1/2 (s - origin)' second (s - origin)."""

    origin: Array
    value: Array
    gradient: Array
    second: Array

    @staticmethod
    @torch.no_grad()
    def sample(raw: Callable[[Tensor], Tensor], origin: Array, step: float) -> _Quadratic:
        """Exact for quadratics whatever the step; differences are not limits here."""
        p = len(origin)

        def at(*moved: tuple[int, float]) -> Array:
            s = torch.tensor(origin, dtype=torch.float64)
            for index, by in moved:
                s[index] += by
            return raw(s).numpy().copy()

        h = 0.1 * step
        value = at()
        plus = [at((i, h)) for i in range(p)]
        minus = [at((i, -h)) for i in range(p)]
        gradient = np.zeros((len(value), p))
        hessian = np.zeros((len(value), p, p))
        for i in range(p):
            gradient[:, i] = (plus[i] - minus[i]) / (2.0 * h)
            hessian[:, i, i] = (plus[i] + minus[i] - 2.0 * value) / h**2
            for j in range(i):
                mixed = (at((i, h), (j, h)) - plus[i] - plus[j] + value) / h**2
                hessian[:, i, j] = hessian[:, j, i] = mixed
        return _Quadratic(origin.copy(), value, gradient, hessian)

    def at(self, s: Array) -> tuple[Array, Array]:
        """Values and Jacobian."""
        step = s - self.origin
        slope = self.second @ step
        return self.value + self.gradient @ step + 0.5 * slope @ step, self.gradient + slope

    def hessian(self, _: Array, weights: Array) -> Array:
        """Hessian of weights . y, (p, p)."""
        return np.einsum("y,ypq->pq", weights, self.second)

    @torch.no_grad()
    def fits(self, raw: Callable[[Tensor], Tensor], s: Array) -> bool:
        """Whether it is the function at s too."""
        exact = raw(torch.tensor(s, dtype=torch.float64)).numpy()
        scale = np.abs(exact).max() + np.abs(self.value).max()
        return bool(np.abs(self.at(s)[0] - exact).max() < RTOL * scale)
