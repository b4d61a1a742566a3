"""Why a Riccati or Lyapunov equation of a control problem has no solution, in words."""

from __future__ import annotations

from typing import NoReturn

import numpy as np

from diffsim.core.errors import DiffsimError

_DROP = 1e-9  # singular value of [A - s, B], relative to the entries, that counts as zero
_AXIS = 1e-7  # real part, relative to A, that counts as zero: double roots split by sqrt(1e-16)


class RiccatiError(DiffsimError):
    """An LQR problem or a Lyapunov equation without the solution asked for.

    Attributes:
        reason: "not_stabilizable", "undetectable", "singular" or "not_converged".
        eigenvalue: Eigenvalue of the mode that prevents a solution [1/s], None if no single one
            does.
        mode: Direction of that mode in the state, (n,) complex of unit length; None as above.
    """

    def __init__(
        self,
        message: str,
        *,
        reason: str,
        eigenvalue: complex | None = None,
        mode: np.ndarray | None = None,
    ):
        super().__init__(message)
        self.reason = reason
        self.eigenvalue = eigenvalue
        self.mode = mode


def unreachable_mode(
    A: np.ndarray, B: np.ndarray, *, axis_only: bool = False
) -> tuple[complex, np.ndarray] | None:
    """The eigenvalue and left vector of a mode that does not decay and that B cannot move.

    Popov-Belevitch-Hautus: (A, B) is stabilizable if and only if [A - s, B] has full rank for every
    eigenvalue s of A with a real part that is not negative.

    Args:
        A: State matrix, (n, n) [1/s].
        B: (n, m).
        axis_only: Modes that neither decay nor grow only.

    Returns:
        Eigenvalue and unit vector, (n,), or None if there is none.
    """
    scale = max(float(np.linalg.norm(A, 2)), 1e-300)
    width = max(float(np.linalg.norm(B, 2)), 1e-300)
    for value in np.linalg.eigvals(A):
        real = value.real if abs(value.real) > _AXIS * scale else 0.0
        if real < 0.0 or (axis_only and real > 0.0):
            continue
        if abs(value) <= np.sqrt(_AXIS) * scale:  # integrator chains: rounding splits their zeros
            value = 0.0
        pencil = np.hstack([(A - value * np.eye(len(A))) / scale, B / width])
        left, singular, _ = np.linalg.svd(pencil)
        if singular[-1] < _DROP:
            return complex(value), left[:, -1]
    return None


def _where(index: int | None) -> str:
    return "" if index is None else f" (batch entry {index})"


def _largest_states(mode: np.ndarray) -> str:
    order = np.argsort(-np.abs(mode))
    shown = [int(i) for i in order if abs(mode[i]) > 0.1][:4]
    return ", ".join(f"{i} ({abs(mode[i]):.2f})" for i in shown)


def raise_riccati_failure(
    A: np.ndarray, G: np.ndarray, Q: np.ndarray, residual: float, index: int | None
) -> NoReturn:
    """Raise the RiccatiError that says why A'P + PA - PGP + Q = 0 was not solved."""
    if (worst := unreachable_mode(A, G)) is not None:
        eigenvalue, mode = worst
        raise RiccatiError(
            f"(A, B) is not stabilizable{_where(index)}: no input moves the mode of eigenvalue "
            f"{eigenvalue:.3g} 1/s, which does not decay, along states {_largest_states(mode)}; "
            "change the design (rotor positions, axes, spins) or leave that state out",
            reason="not_stabilizable",
            eigenvalue=eigenvalue,
            mode=mode,
        )
    if (worst := unreachable_mode(A.T, Q, axis_only=True)) is not None:
        eigenvalue, mode = worst
        raise RiccatiError(
            f"(A, Q) is undetectable{_where(index)}: Q does not see the mode of eigenvalue "
            f"{eigenvalue:.3g} 1/s, which does not decay, along states {_largest_states(mode)}; "
            "give these states a weight in Q above zero",
            reason="undetectable",
            eigenvalue=eigenvalue,
            mode=mode,
        )
    raise RiccatiError(
        f"the Riccati equation was not solved{_where(index)}: relative residual {residual:.1e}, "
        "needed 1e-08 and a stable closed loop; the problem is close to not stabilizable or "
        "undetectable, or badly scaled: rescale the states, Q or R",
        reason="not_converged",
    )


def raise_lyapunov_failure(A: np.ndarray, index: int | None) -> NoReturn:
    """Raise the RiccatiError that says which eigenvalues of A add up to zero."""
    values = np.linalg.eigvals(A)
    sums = np.abs(values[:, None] + values[None, :].conj())
    i, j = np.unravel_index(np.argmin(sums), sums.shape)
    raise RiccatiError(
        f"A X + X A' + Q = 0 has no unique solution{_where(index)}: the eigenvalues "
        f"{values[i]:.3g} and {values[j]:.3g} of A add up to zero; A must be stable",
        reason="singular",
        eigenvalue=complex(values[i]),
    )
