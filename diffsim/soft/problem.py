"""The problem of one implicit step, as the ops take it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

from diffsim.soft import _ops_step
from diffsim.soft.inputs import EMPTY, flat
from diffsim.soft.options import SolverOptions
from diffsim.soft.physics import Physics

if TYPE_CHECKING:
    from diffsim.soft.body import SoftBody


@dataclass(frozen=True, kw_only=True)
class Problem:
    """argmin 1/2 |x - y|^2_inertia - force.x + E(x) + D(x) - p V(x), x = target where fixed.

    The layer under every integrator and under statics; see csrc/kernels/soft/implicit_step.h. All
    states (..., num_vertices, 3), inertia (num_vertices,) [N/m].
    """

    y: Tensor
    force: Tensor
    target: Tensor
    guess: Tensor
    inertia: Tensor
    activation: Tensor
    pressure: Tensor
    physics: Physics
    damping: tuple[Tensor, Tensor] = (EMPTY, EMPTY)
    x_frame: Tensor | None = None
    x_velocity: Tensor | None = None

    def inputs(self, body: SoftBody) -> list[Tensor]:
        """The tensors in the order of ``STEP_INPUTS``, batch axes flattened."""
        physics = self.physics
        stiffness, stretch = body.muscles.fibres(physics.fibre_stiffness, self.activation)
        return [
            flat(self.y),
            flat(self.force),
            flat(self.target),
            flat(self.guess.detach()),
            self.inertia.contiguous(),
            physics.w_mu,
            physics.w_vol,
            stiffness.contiguous(),
            flat(stretch, 1),
            *(d.contiguous() for d in self.damping),
            EMPTY if self.x_frame is None else flat(self.x_frame),
            EMPTY if self.x_velocity is None else flat(self.x_velocity),
            flat(self.pressure, 1),
        ]


def solve(body: SoftBody, problem: Problem) -> Tensor:
    """The positions (..., num_vertices, 3) that solve a problem [m]."""
    x, _ = _ops_step.soft_step(problem.inputs(body), body.handle, *solver_arguments(body.solver))
    return x.reshape(problem.y.shape)


def solver_arguments(options: SolverOptions) -> tuple:
    """How the ops take the solver's options."""
    return (
        options.method,
        options.rtol,
        options.atol,
        options.max_iters,
        options.num_threads,
        options.on_failure,
        options.rtol if options.adjoint_rtol is None else options.adjoint_rtol,
        options.adjoint_max_iters,
    )
