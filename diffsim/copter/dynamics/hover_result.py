"""The result of a hover solve, and its warnings and errors."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.copter.dynamics import _ops_hover
from diffsim.core.checked import checked
from diffsim.core.errors import DiffsimError
from diffsim.core.numbers import values_of
from diffsim.core.record import Ended, Solve, warn
from diffsim.core.rotation import matrix_from_rpy


class HoverError(DiffsimError):
    """A design does not hover within its thrust limits, or the solve failed.

    Attributes:
        result: The thrusts of least violation and their status.
    """

    def __init__(self, message: str, result: HoverResult):
        super().__init__(message)
        self.result = result


_ENDED: dict[str, Ended] = {
    "optimal": "converged",
    "rank_deficient": "rank_deficient",
    "infeasible": "infeasible",
    "not_converged": "budget",
}


class HoverWarning(UserWarning):
    """A hover that is rank deficient or did not converge."""


@checked(kinds_only=True)
@dataclass(frozen=True, eq=False)
class HoverResult:
    """Thrusts that hold a multicopter in place, and the status of the solve.

    Attributes:
        thrusts: Thrust of each rotor, (..., n_rotors) [N].
        attitude: Roll and pitch at yaw zero (NED, R = Rz Ry Rx), (..., 2) [rad].
        residual: Excess of lift over weight and the three torques, (..., 4), in shares of the
            weight and of weight times mean lever; zero at a hover. Where there is none its gradient
            leads back to one.
        multipliers: Multipliers of those four conditions, (..., 4); no gradients.
        status_code: Index into ``HoverResult.STATUSES``, (...) int64.
        rank: Rank of the four conditions in the thrusts of all rotors, (...) int64; below 4 the
            hover is not controllable.
        free_rank: Rank of the four conditions in the rotors strictly between their limits.
        active_lower, active_upper: Rotors that stand at zero or at their limit, (..., n_rotors).
        weakly_active: Rotors about to reach or to leave a limit: there the derivative of the
            thrusts is one-sided, and the one given is that of the present active set.
        num_iters: Turns of the attitude, (...) int64.
    """

    STATUSES = _ops_hover.STATUSES

    thrusts: Tensor
    attitude: Tensor
    residual: Tensor
    multipliers: Tensor
    status_code: Tensor
    rank: Tensor
    free_rank: Tensor
    active_lower: Tensor
    active_upper: Tensor
    weakly_active: Tensor
    num_iters: Tensor

    @property
    def status(self) -> str | list[str]:
        """optimal, infeasible, rank_deficient or not_converged; a flat list for a batch."""
        names = [self.STATUSES[int(code)] for code in self.status_code.flatten()]
        return names[0] if self.status_code.ndim == 0 else names

    @property
    def solve(self) -> Solve:
        """Why every hover of the batch ended, in its flat order."""
        codes = values_of(self.status_code).flatten().tolist()
        norms = values_of(self.residual).reshape(-1, 4).norm(dim=-1).tolist()
        return Solve(
            solver="hover",
            ended=tuple(_ENDED[self.STATUSES[code]] for code in codes),
            residual=tuple(norms),
            tolerance=(_ops_hover.FEASIBLE,) * len(codes),
            num_iters=tuple(values_of(self.num_iters).flatten().tolist()),
        )

    @property
    def feasible(self) -> Tensor:
        """Where the thrusts hold the vehicle, (...) bool."""
        return (self.status_code == 0) | (self.status_code == 2)

    @property
    def residual_norm(self) -> Tensor:
        """(...) [-]."""
        return torch.linalg.vector_norm(self.residual, dim=-1)

    @property
    def rot_world_from_body(self) -> Tensor:
        """(..., 3, 3) [-]."""
        roll, pitch = self.attitude.unbind(-1)
        return matrix_from_rpy(torch.stack([roll, pitch, torch.zeros_like(roll)], -1))


def report(result: HoverResult, on_infeasible: str) -> None:
    """Raise or warn if the hover of a design failed or is rank deficient.

    There is one design, or as many as ``torch.func.vmap`` maps.
    """
    codes = values_of(result.status_code).flatten().tolist()
    residuals = values_of(result.residual).reshape(-1, 4).tolist()
    ranks = zip(
        *(values_of(r).flatten().tolist() for r in (result.free_rank, result.rank)), strict=True
    )
    for code, residual, found in zip(codes, residuals, ranks, strict=True):
        _report_one(result, result.STATUSES[code], residual, found, on_infeasible)


def _report_one(
    result: HoverResult,
    status: str,
    residual: list[float],
    ranks: tuple[int, ...],
    on_infeasible: str,
) -> None:
    free_rank, rank = ranks
    shown = (
        f"lift {100.0 * (1.0 + residual[0]):.4g} % of the weight, torques "
        f"({', '.join(f'{t:.2g}' for t in residual[1:])}) of weight times mean lever"
    )
    if status == "infeasible" and on_infeasible == "raise":
        raise HoverError(
            f"no thrusts within the limits hover; nearest: {shown}; lighten the load, raise "
            "max_thrusts or move rotors (result.residual has the gradient)",
            result,
        )
    if status == "not_converged":
        message = f"the hover solve did not converge; last: {shown}; try smoothing=1e-4"
        if on_infeasible == "raise":
            raise HoverError(message, result)
        warn(message, HoverWarning, stacklevel=5)
    if status == "rank_deficient":
        warn(
            f"the free rotors command {free_rank} of lift, roll, pitch and yaw (all "
            f"rotors: {rank}): hovering, but derivatives are least-norm ones and "
            "the vehicle cannot be controlled there; move rotors or change axes or spins",
            HoverWarning,
            stacklevel=5,
        )
