"""Options of a soft body: its damping, masses, contact and solver."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from diffsim.core.check import require_choice, require_number, require_threads
from diffsim.core.checked import checked
from diffsim.soft import _ops_step
from diffsim.soft._context import MULTIGRID_METHODS, PRECONDITIONERS
from diffsim.soft.parameters import Value


@checked(kinds_only=True)
@dataclass(frozen=True, kw_only=True, eq=False)
class Damping:
    """Rayleigh damping: force -(alpha M + beta K) v.

    Attributes:
        rayleigh_alpha: Mass-proportional damping, scalar [1/s], >= 0.
        rayleigh_beta: Stiffness-proportional damping, scalar or (num_elements,) [s], >= 0; see
            csrc/kernels/soft/damping.h for its objective form. A number 0 switches it off.
    """

    rayleigh_alpha: Value = 0.0
    rayleigh_beta: Value = 0.0


@checked(kinds_only=True)
@dataclass(frozen=True, kw_only=True, eq=False)
class Masses:
    """Masses of nodes besides that of the solid.

    Attributes:
        attached_mass: Point masses, (num_nodes,) [kg]; they weigh and are inert.
        added_mass: Inertia without weight, of surrounding water say, (num_nodes,) [kg]; see
            :func:`~diffsim.soft.added_mass`.
        node_mass: Nodal masses instead of those of ``density``, (num_nodes,) [kg].
    """

    attached_mass: Tensor | None = None
    added_mass: Tensor | None = None
    node_mass: Tensor | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactOptions:
    """Which nodes meet obstacles, and how fast they leave them.

    Attributes:
        contact_nodes: Nodes that touch obstacles, (k,) int64; None: all surface nodes without
            Dirichlet conditions.
        max_depenetration_speed: Nodes that start inside an obstacle are pushed out no faster
            [m/s].
    """

    contact_nodes: Tensor | None = None
    max_depenetration_speed: float = math.inf

    def __post_init__(self) -> None:
        speed = self.max_depenetration_speed
        if speed != math.inf:
            require_number("max_depenetration_speed", speed, above=0.0, hint="unit is m/s")


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """Solver and tolerances of an implicit step and its adjoint.

    Attributes:
        method: ``auto``, or ``quasi_newton`` (L-BFGS on the constant factor), ``newton_pcg``
            (Newton, conjugate gradients on the constant factor), ``newton_jacobi``
            (the same with 3x3 Jacobi, as in textbook baselines), ``newton_cholesky`` (Newton,
            sparse Cholesky of the tangent at every iteration). ``linearly_implicit`` does not
            iterate: a step is one Newton step from the old positions, one linear solve, as in
            the linearly implicit Euler method; see docs/soft.md for what that costs in accuracy.
        preconditioner: What conjugate gradients run on, in the step, its adjoint and its
            derivatives: ``constant`` (the constant factor), ``multigrid`` (smoothed aggregation of
            the tangent; few iterations at any size and any contrast of stiffness; for the methods
            ``auto`` and ``newton_pcg``), or ``auto``: for method ``auto`` multigrid from 300 nodes
            on where it needs less time at rest, for the other methods the constant factor. Steps
            with obstacles compare both by the costs of contact. Answers agree within ``rtol``.
        rtol: The residual must fall below ``rtol * scale + atol``; scale is
            |inertia (y - mean y)| + |force| over free nodes (the right-hand side of eq. 4.3 about
            the body's center) [-]. Without load (statics), scale is the residual at the start, and
            the tolerance is at least rounding, 4e-16 |diag(A) x|.
        atol: Absolute part of that tolerance [N].
        adjoint_rtol: Tolerance of the adjoint: |H z - dL/dx| must fall below
            ``adjoint_rtol * |dL/dx|``; None: rtol [-].
        max_iters: Largest number of outer iterations [-].
        adjoint_max_iters: Largest number of Krylov iterations of the adjoint, and of a linearly
            implicit step [-].
        cache_columns: Whether steps with obstacles keep columns of the constant matrix's inverse
            from step to step (thesis Alg. 5), where they are on that matrix. False only to measure
            what that is worth.
        num_threads: Threads of one step; a batch deals its items out to them [-].
        on_failure: ``raise`` :class:`~diffsim.core.errors.ConvergenceError`, or ``warn``.
    """

    method: str = "auto"
    preconditioner: str = "auto"
    rtol: float = 1e-6
    atol: float = 0.0
    adjoint_rtol: float | None = None
    max_iters: int = 500
    adjoint_max_iters: int = 5000
    cache_columns: bool = True
    num_threads: int = 1
    on_failure: str = "raise"

    def __post_init__(self) -> None:
        require_choice("method", self.method, _ops_step.METHODS)
        require_choice("preconditioner", self.preconditioner, PRECONDITIONERS)
        if self.preconditioner == "multigrid" and self.method not in MULTIGRID_METHODS:
            raise ValueError(
                f"preconditioner must be 'auto' or 'constant' for method={self.method!r}, got "
                f"'multigrid', which serves the methods {list(MULTIGRID_METHODS)}"
            )
        require_number("rtol", self.rtol, above=0.0, below=1.0)
        require_number("atol", self.atol, at_least=0.0)
        if self.adjoint_rtol is not None:
            require_number("adjoint_rtol", self.adjoint_rtol, above=0.0, below=1.0)
        if not isinstance(self.cache_columns, bool):
            raise TypeError(
                f"cache_columns must be True or False, got {type(self.cache_columns).__name__}"
            )
        for name in ("max_iters", "adjoint_max_iters"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int):
                raise TypeError(f"{name} must be an int, got {type(value).__name__}")
            require_number(name, value, at_least=1)
        require_threads(self.num_threads)
        require_choice("on_failure", self.on_failure, ("raise", "warn"))

    def arguments(self) -> dict[str, Any]:
        """Keyword arguments of the step's op."""
        linear = self.method == _ops_step.LINEAR
        return {
            "method": self.method,
            "preconditioner": self.preconditioner,
            "rtol": self.rtol,
            "atol": self.atol,
            "max_iters": self.adjoint_max_iters if linear else self.max_iters,
            "num_threads": self.num_threads,
            "on_failure": self.on_failure,
            "adjoint_rtol": self.rtol if self.adjoint_rtol is None else self.adjoint_rtol,
            "adjoint_max_iters": self.adjoint_max_iters,
        }
