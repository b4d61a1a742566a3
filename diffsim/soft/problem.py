"""The problem of one implicit step, as the ops take it."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from diffsim.soft._arrays import StepArrays
from diffsim.soft.inputs import DampingFrame, Loads, energy_terms, flat
from diffsim.soft.integrators import ImplicitStage


@dataclass(frozen=True, kw_only=True, eq=False)
class StepProblem:
    """argmin 1/2 |x - y|^2_inertia - force.x + E(x) + D(x) - p V(x), x = target where fixed.

    The layer under every integrator and under statics; see csrc/kernels/soft/implicit_step.h.
    """

    y: Tensor  # inertial positions, (..., num_nodes, 3) [m]
    # start of the iteration, (..., num_nodes, 3) [m]; no gradient but in linearly implicit steps,
    # which are one Newton step from it
    guess: Tensor
    inertia: Tensor  # inertia per displacement of each node, (num_nodes,) [N/m]
    loads: Loads  # forces, targets, activations, pressures and physics
    frame: DampingFrame | None = None  # reference of the damping energy D; None: undamped

    def arrays(self) -> StepArrays:
        """The tensors that the ops take, batch axes flattened."""
        is_linear = self.loads.prepared.is_linear
        return StepArrays(
            **energy_terms(self.loads, self.frame),
            y=flat(self.y),
            force=flat(self.loads.force),
            target=flat(self.loads.target),
            guess=flat(self.guess if is_linear else self.guess.detach()),
            inertia=self.inertia.contiguous(),
        )


def solve(problem: StepProblem, *, iterate: bool = False) -> Tensor:
    """The positions (..., num_nodes, 3) that solve a problem [m].

    Args:
        iterate: Whether the solution is asked for where the body's own steps are linearly implicit.
    """
    x = problem.loads.prepared.solve(problem.arrays(), iterate=iterate)
    return x.reshape(problem.y.shape)


def stage_problem(stage: ImplicitStage, guess: Tensor, loads: Loads) -> StepProblem:
    """The stage's problem; mass-proportional damping joins the inertia term.

    Args:
        stage: The integrator's implicit problem.
        guess: Start of the iteration, where the step begins, (..., num_nodes, 3) [m].
        loads: What acts in the step.
    """
    terms, c = loads.prepared.terms(stage.rates), stage.rates.c
    if stage.midpoint:  # the unknown is in the middle of the step
        loads = loads.with_target(0.5 * (guess + loads.target))
    return StepProblem(
        y=(c * stage.y + terms.alpha * stage.x_velocity) / terms.total,
        guess=guess,
        inertia=terms.inertia,
        loads=loads,
        frame=DampingFrame(weights=terms.damping, x_frame=stage.y, x_velocity=stage.x_velocity),
    )
