"""How the equations of a Stokes flow are solved."""

from __future__ import annotations

from dataclasses import dataclass

from diffsim.core.check import require_choice, require_number, require_threads

METHODS = ("auto", "direct", "iterative")


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """Solver and tolerances of a flow and its adjoint.

    Attributes:
        method: ``direct`` (sparse Cholesky of the velocities' matrix), ``iterative`` (flexible
            GMRES on velocities and pressures of the same equations, geometric multigrid inside:
            memory and time grow in proportion to the grid) or ``auto``: iterative in three
            dimensions beyond ``MAX_DIRECT_NODES`` nodes with fluid, about where both take the same
            time, and where incompressible; where that does not converge, direct.
            ``StokesFlow.report`` says which was taken.
        rtol: Largest norm of the residual over that of the right-hand side, both with momentum and
            continuity scaled by powers of the cell size; the adjoint and the tangent too. The
            iterative solver goes on until then; the direct one corrects its answer by the residual,
            and ends at what rounding leaves (1e-12). Pressures that alternate from cell to cell are
            held weakly: by the iterative solver, errors there are 1e2 to 1e4 times larger [-].
        tolerance: Largest relative divergence that an incompressible flow may keep, and, of the
            direct solver, largest estimated relative error of its pressures; see
            ``FlowField.stats`` [-].
        max_iters: Largest number of incompressible iterations, and of the iterative solver's [-].
        num_kept: Factorized systems to keep; one is enough where every forward pass is followed by
            its backward pass [-].
        num_threads: Worker threads; results do not depend on them [-].
        on_failure: What an iteration does that does not converge: ``raise`` or ``warn``.
    """

    method: str = "auto"
    rtol: float = 1e-9
    tolerance: float = 1e-8
    max_iters: int = 100
    num_kept: int = 1
    num_threads: int = 1
    on_failure: str = "raise"

    def __post_init__(self) -> None:
        require_choice("method", self.method, METHODS)
        require_number("rtol", self.rtol, at_least=1e-13, at_most=0.1)
        require_number("tolerance", self.tolerance, above=0.0)
        for name in ("max_iters", "num_kept"):
            count = getattr(self, name)
            if isinstance(count, bool) or not isinstance(count, int) or count < 1:
                raise ValueError(f"{name} must be an integer >= 1, got {count!r}")
        require_threads(self.num_threads)
        require_choice("on_failure", self.on_failure, ("raise", "warn"))
