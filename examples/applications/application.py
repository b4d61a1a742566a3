"""An application: parameters within bounds, a simulation of them, and a loss."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim import soft
from diffsim.contact import Obstacle
from diffsim.core.check import require_choice

Array = NDArray[np.float64]

SOLVERS = {
    "projective_dynamics": "auto",
    "newton_cholesky": "newton_cholesky",
    "newton_pcg": "newton_jacobi",
}
"""Our solver and the thesis's two baselines, by their ``SolverOptions.method``."""


def solver_options(name: str, **options: Any) -> soft.SolverOptions:
    """Options of one of ``SOLVERS``; the rest as in :class:`~diffsim.soft.SolverOptions`."""
    require_choice("solver", name, tuple(SOLVERS))
    return soft.SolverOptions(method=SOLVERS[name], **options)


@dataclass(frozen=True, kw_only=True)
class Parameters:
    """What is optimized: names, bounds and a first guess, all (num_parameters,).

    The optimizer sees them scaled to [0, 1] between the bounds. What should be optimized on a
    logarithmic scale is given as its logarithm.
    """

    names: tuple[str, ...]
    lower: Array
    upper: Array
    first: Array

    def __post_init__(self) -> None:
        for name in ("lower", "upper", "first"):
            value = np.asarray(getattr(self, name), float)
            if value.shape != (len(self.names),) or not np.isfinite(value).all():
                raise ValueError(
                    f"{name} must be {len(self.names)} finite numbers, one per name, "
                    f"got shape {value.shape}"
                )
            object.__setattr__(self, name, value)
        if not (self.lower < self.upper).all():
            bad = [n for n, a, b in zip(self.names, self.lower, self.upper, strict=True) if a >= b]
            raise ValueError(f"lower must be below upper, it is not for {bad}")
        if not ((self.lower <= self.first) & (self.first <= self.upper)).all():
            raise ValueError("first must lie between lower and upper")

    def scaled(self, values: Array) -> Array:
        """Values as the optimizer sees them, 0 at the lower bound, 1 at the upper."""
        return (values - self.lower) / (self.upper - self.lower)

    def values(self, scaled: Array) -> Array:
        """The reverse of ``scaled``."""
        return np.clip(self.lower + scaled * (self.upper - self.lower), self.lower, self.upper)

    def random(self, rng: np.random.Generator) -> Array:
        """Uniform between the bounds."""
        return self.values(rng.uniform(size=len(self.names)))


@dataclass(frozen=True, eq=False, kw_only=True)
class Application:
    """One application, built for one solver and one size.

    Attributes:
        name: Such as "plant"; the script's name under examples/applications.
        title: What is asked, one line.
        source: Where it is from, such as "thesis Fig. 4-9".
        body: The soft body; its solver's options are those compared.
        parameters: What is optimized.
        simulate: Positions of all steps, (num_steps + 1, num_nodes, 3) [m], of parameters
            (num_parameters,); with gradient.
        loss: Loss of parameters and those positions; a scalar, with gradient.
        numbers: What the parameters and the motion mean to a person, by name with unit.
        oracle: Smallest loss that there can be, 0 of the normalized loss; None: nobody knows, and
            the best of our solver's is taken (thesis: walking and swimming).
        oracle_parameters: Parameters the target was made with, if it was, for comparison.
        warm_up: The same parameters with an easier loss, of a shorter motion say, whose answer is
            the first guess of this one.
        obstacles: Obstacles for pictures.
        follow: Maps positions (..., num_nodes, 3), the point (..., 3) whose path pictures show.
        targets: Points to draw, by name, (3,) [m].
        num_starts: Random first guesses of which the best is taken; 1: only ``parameters.first``.
        scale: The optimizer sees the loss over this; None: over the first loss. All parameters are
            bounded, so the first step of L-BFGS-B is the slope of what it sees (of parameters from
            0 to 1): a scale of some five times the loss's slope keeps it inside.
    """

    name: str
    title: str
    source: str
    body: soft.SoftBody
    parameters: Parameters
    simulate: Callable[[Tensor], Tensor]
    loss: Callable[[Tensor, Tensor], Tensor]
    numbers: Callable[[Array, Tensor], Mapping[str, float]]
    oracle: float | None = 0.0
    oracle_parameters: Array | None = None
    warm_up: Application | None = None
    obstacles: Sequence[Obstacle] = ()
    follow: Callable[[Tensor], Tensor] | None = None
    targets: Mapping[str, Sequence[float]] = field(default_factory=dict)
    num_starts: int = 1
    scale: float | None = None

    @property
    def num_dofs(self) -> int:
        """Degrees of freedom, fixed ones included, as Table 4.2 counts them."""
        return 3 * self.body.mesh.num_nodes

    def motion(self, values: Array) -> Tensor:
        """Positions of all steps, without gradient; kept, since stories ask for them again."""
        kept = self.__dict__.setdefault("_motions", {})
        key = tuple(np.asarray(values, float).tolist())
        if key not in kept:
            with torch.no_grad():
                kept[key] = self.simulate(torch.tensor(key, dtype=torch.float64))
        return kept[key]
