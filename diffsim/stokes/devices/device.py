"""What a fluidic device is: parameters, shape, flow problems, loss."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from diffsim.core.check import require, require_constants, require_count
from diffsim.core.checked import checked
from diffsim.core.errors import DiffsimError
from diffsim.stokes.field import FlowField
from diffsim.stokes.flow import StokesFlow
from diffsim.stokes.grid import Grid
from diffsim.stokes.options import SolverOptions
from diffsim.stokes.shapes import Shape

SOLVER = SolverOptions(rtol=1e-5)
"""Of the devices that "auto" solves by iteration on the thesis's grids, in half of the iterations
of 1e-9. Of eight random designs losses were within 5e-6 and gradients within 2e-4 of the factor's;
the grid's own error is 1e-2."""


@checked
@dataclass(frozen=True)
class Parameter:
    """A number to design, uniform within its bounds where designs are sampled.

    Attributes:
        name: Description of the parameter.
        lower: Least value, lengths [m] and angles [rad].
        upper: Largest value that a search may try.
    """

    name: str
    lower: float
    upper: float

    def __post_init__(self) -> None:
        if not self.lower < self.upper:
            raise ValueError(f"{self.name}: lower {self.lower} must be below upper {self.upper}")


@checked(kinds_only=True)
@dataclass(frozen=True, eq=False)
class State:
    """One geometry of a device; most have one, a switch has one per position.

    Attributes:
        name: Title in pictures.
        shape: Function from parameters (num_parameters,) to the level set of the fluid.
        inlet: Velocity of every inlet by name, (cases, 1, dim) [m/s]: one case per basis input.
        loss: Function from the flow to a loss, scalar, not normalized.
    """

    name: str
    shape: Callable[[Tensor], Shape]
    inlet: Mapping[str, Tensor]
    loss: Callable[[FlowField], Tensor]


@dataclass(frozen=True, eq=False)
class Device:
    """A design problem: which parameters make the flow do what is wanted?

    Lengths are in units of the box's width or height, speeds in units of an inlet's: a Stokes flow
    has no scale of its own, so both may be multiplied at will.

    Attributes:
        name: Name for ``make``.
        flow: Solver with its grid, conditions on the box and kind of wall.
        parameters: Parameters of the design.
        states: Geometries of the device; the loss is the sum over them.
        num_samples: Random designs that the thesis draws for this many parameters.
        cases: Names of the inlet cases.
        directions: Wanted direction (x, y) at the outlets for every case, where that is the aim;
            pictures then show angles to it.
        slices: Heights of horizontal planes that pictures show, as shares of the box (3D).
        reference: Values of thesis table 4.5: "loss", "seconds" per call on its machine.
        options: Options that the device was made with.
        remake: Function without arguments that makes the same device, a function of a module or a
            ``functools.partial`` of one: how the device comes to a worker of an executor.
    """

    name: str
    flow: StokesFlow
    parameters: tuple[Parameter, ...]
    states: tuple[State, ...]
    num_samples: int
    cases: tuple[str, ...] = ("flow",)
    directions: tuple[tuple[float, float], ...] = ()
    slices: tuple[float, ...] = (0.5,)
    reference: Mapping[str, float] = field(default_factory=dict)
    options: Mapping[str, object] = field(default_factory=dict)
    remake: Callable[[], Device] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        if self.remake is None:
            raise TypeError(
                f"device {self.name} cannot be sent to a worker: give it remake, a function of a "
                "module that makes it, or take no executor"
            )
        return _made_again, (pickle.dumps(self.remake),)

    @property
    def grid(self) -> Grid:
        """The grid."""
        return self.flow.grid

    @property
    def lower(self) -> Tensor:
        """Lower bounds, (num_parameters,)."""
        return torch.tensor([p.lower for p in self.parameters], dtype=torch.float64)

    @property
    def upper(self) -> Tensor:
        """Upper bounds, (num_parameters,)."""
        return torch.tensor([p.upper for p in self.parameters], dtype=torch.float64)

    @checked
    def sample(self, generator: torch.Generator) -> Tensor:
        """A random design, uniform within the bounds, (num_parameters,)."""
        share = torch.rand(len(self.parameters), generator=generator, dtype=torch.float64)
        return self.lower + share * (self.upper - self.lower)

    @checked
    def level_set(self, x: Tensor, state: int = 0) -> Tensor:
        """phi at the grid's nodes, (*node_shape,) [m], > 0 in the fluid. Gradient: x."""
        x = self._checked_x(x)
        if require_count("state", state) >= len(self.states):
            raise ValueError(f"state must lie in [0, {len(self.states)}), got {state}")
        return self.states[state].shape(x)(self.grid.nodes)

    @checked
    def solve(self, x: Tensor, state: int = 0) -> FlowField:
        """Flow of a design, one case per basis input.

        Args:
            x: Parameters, (num_parameters,) float64.
            state: Index of the geometry.

        Returns:
            ``FlowField``. Gradient: x.

        Raises:
            ValueError: a design that lets no fluid through; those exist within the bounds.
        """
        phi = self.level_set(x, state)
        return self.flow(phi, inlet=self.states[state].inlet)

    @checked
    def loss(self, x: Tensor) -> Tensor:
        """Loss, scalar, not normalized. Gradient: x."""
        losses = [s.loss(self.solve(x, k)) for k, s in enumerate(self.states)]
        return torch.stack(losses).sum()

    @checked
    def value_and_gradient(self, x: Tensor) -> tuple[float, Tensor]:
        """Loss and its gradient (num_parameters,); one factorization in memory at a time."""
        require_constants("the gradient comes as numbers; loss(x) can be differentiated", x=x)
        x = self._checked_x(x).detach().clone().requires_grad_(True)
        value = 0.0
        for k, state in enumerate(self.states):
            loss = state.loss(self.solve(x, k))
            loss.backward()
            value += float(loss.detach())
        assert x.grad is not None
        return value, x.grad

    @checked
    def value(self, x: Tensor) -> float:
        """Loss without gradient."""
        with torch.no_grad():
            return sum(float(s.loss(self.solve(x, k))) for k, s in enumerate(self.states))

    def _checked_x(self, x: Tensor) -> Tensor:
        return require("x", x, (len(self.parameters),))


_MADE: dict[bytes, Device] = {}  # of a worker: the grid's geometry is made once, not per design


def _made_again(remake: bytes) -> Device:
    if remake not in _MADE:
        _MADE.clear()  # large; a worker has one device at a time
        _MADE[remake] = pickle.loads(remake)()
    return _MADE[remake]


FAILURES = (ValueError, DiffsimError)
"""What a design raises that has no flow: passages closed, curves without an inside."""


@contextmanager
def quiet() -> Iterator[None]:
    """Without the warnings about thin parts and crossing curves that random designs have."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def scaled(shape: Sequence[int], resolution: float) -> tuple[int, ...]:
    """Cells per axis times a factor, at least two."""
    if not 0.0 < resolution <= 8.0:
        raise ValueError(f"resolution must lie in (0, 8], got {resolution}")
    return tuple(max(2, round(n * resolution)) for n in shape)


def basis_inputs(*names: str, directions: Sequence[Sequence[float]]) -> dict[str, Tensor]:
    """One case per inlet in which it alone flows, name to (cases, 1, dim) [m/s]."""
    unit = torch.eye(len(names), dtype=torch.float64)
    vectors = torch.tensor(directions, dtype=torch.float64)
    return {n: unit[:, k, None, None] * vectors[k] for k, n in enumerate(names)}


def between(grid: Grid, axis: int, low: float, high: float) -> Callable[[Tensor], Tensor]:
    """Nodes of an inlet [low, high] along an axis: all those of cells that it overlaps."""
    h = grid.spacing[axis] * (1.0 - 1e-6)

    def where(points: Tensor) -> Tensor:
        return (points[:, axis] > low - h) & (points[:, axis] < high + h)

    return where


def points2d(rows: Sequence[Sequence[float | Tensor]], x: Tensor) -> Tensor:
    """Control points (k, 2) from numbers and entries of x."""
    entries = [torch.as_tensor(e, dtype=x.dtype) for row in rows for e in row]
    return torch.stack(entries).reshape(-1, 2)
