"""How well a multicopter can be controlled: quantities for co-design, differentiable (thesis 3.4).

Lift is counted along the body's vertical; with tilted rotors a vehicle that leans its net thrust
upright has a little more.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.copter.dynamics._thrust_lp import max_scale
from diffsim.copter.vehicle.multicopter import Multicopter
from diffsim.core.check import require, require_number, require_range
from diffsim.core.checked import checked
from diffsim.core.errors import DiffsimError
from diffsim.core.numbers import anywhere, require_unmapped, values_of
from diffsim.core.values import as_array

_RANK_DROP = 1e-9  # singular value, relative to the largest, that counts as zero


class Controllability(NamedTuple):
    """Controllability of a linear system; the singular values carry gradients."""

    rank: int  # rank of the controllability matrix
    singular_values: Tensor  # descending, (n,)
    condition: Tensor  # largest over smallest, (); inf where the rank is not full


@checked(A=("n", "n"))
def controllability(A: Tensor, B: Tensor) -> Controllability:
    """Rank and singular values of [B, A B, ..., A^(n-1) B] (thesis 3.4.1).

    Args:
        A: State matrix, (n, n) float64 [1/s].
        B: (n, m) float64.

    Raises:
        TypeError, ValueError: wrong types or shapes, not finite.
    """
    A = require("A", A, ("n", "n"))
    B = require("B", B, (A.shape[0], "m"))
    require_unmapped(A=A, B=B)
    blocks = [B]
    for _ in range(A.shape[0] - 1):
        blocks.append(A @ blocks[-1])
    values = torch.linalg.svdvals(torch.cat(blocks, dim=1))
    rank = int((values.detach() > _RANK_DROP * values.detach()[0]).sum())
    condition = values[0] / values[-1] if rank == len(A) else torch.full_like(values[0], math.inf)
    return Controllability(rank, values, condition)


@checked
def hover_map_singular_value(copter: Multicopter) -> Tensor:
    """Smallest singular value of thrusts to lift, roll, pitch and yaw, () [-].

    Torques in units of the mean lever, thrusts in shares of their sum. Zero where a hover is not
    controllable (rotors in a line), with a gradient that leads away unless the design is symmetric
    there; a barrier on it keeps a search controllable.
    """
    torque = copter.torque_matrix
    lever = torch.linalg.vector_norm(torque) / copter.num_rotors**0.5
    lever = torch.where(lever > 0.0, lever, 1.0)
    rows = torch.cat([_lift(copter), torque / lever]) / copter.num_rotors**0.5
    values = torch.linalg.svdvals(rows)
    return values[-1] if copter.num_rotors >= 4 else 0.0 * values[-1]


@checked
def max_hover_weight(
    copter: Multicopter,
    *,
    torque: Tensor | tuple[float, float, float] = (0.0, 0.0, 0.0),
    smoothing: float = 0.0,
) -> Tensor:
    """The largest weight that the rotors hold up with every torque of a box still to be had.

    Args:
        copter: The vehicle.
        torque: Half extents of the box in x, y and z, (3,) [N m]; zero: lift alone.
        smoothing: Barrier weight [N]; above 0 the result lies below and is smooth in the design.

    Returns:
        Weight, () [N].

    Raises:
        TypeError, ValueError: wrong types or shapes.
        ThrustLimitError: the torques cannot be had at any weight.

    Gradients: positions, directions, torque_ratios, max_thrusts, torque.
    """
    box = _require_box(torque)
    signs = _corners() if bool((box != 0.0).any()) else torch.zeros(1, 3, dtype=torch.float64)
    a = torch.zeros(len(signs), 4, dtype=torch.float64)
    a[:, 0] = 1.0
    b = torch.cat([torch.zeros(len(signs), 1, dtype=torch.float64), signs * box], 1)
    C = torch.cat([_lift(copter), copter.torque_matrix])
    smoothing = require_number("smoothing", smoothing, at_least=0.0)
    what = f"reach the torques +-{box.tolist()} N m"
    return max_scale(C, a, b, copter.max_thrusts, what=what, smoothing=smoothing)


@checked(load=())
def control_authority(
    copter: Multicopter,
    *,
    torque: Tensor | tuple[float, float, float] = (1.0, 1.0, 0.1),
    load: float | Tensor = 0.0,
    smoothing: float = 0.0,
) -> Tensor:
    """How many times a box of torques can be had, in any combination, while the weight is held.

    Args:
        copter: The vehicle.
        torque: Half extents of the box in x, y and z, (3,) [N m].
        load: Weight carried at the center of mass [N].
        smoothing: Barrier weight [-]; above 0 the result lies below and is smooth in the design.

    Returns:
        Scale of the box, () [-].

    Raises:
        TypeError, ValueError: wrong types or shapes, a box of no extent.
        ThrustLimitError: the vehicle does not hover with that load.

    Gradients: mass, positions, directions, torque_ratios, max_thrusts, torque, load.
    """
    box = _require_box(torque)
    if not bool((box != 0.0).any()):
        raise ValueError("torque must have an extent above 0, got all zero")
    signs = _corners()
    require_unmapped(mass=copter.mass, load=torch.as_tensor(load))
    weight = (copter.weight + load).reshape(1, 1).expand(len(signs), 1)
    a = torch.cat([torch.zeros(len(signs), 1, dtype=torch.float64), signs * box], 1)
    b = torch.cat([weight, torch.zeros(len(signs), 3, dtype=torch.float64)], 1)
    C = torch.cat([_lift(copter), copter.torque_matrix])
    smoothing = require_number("smoothing", smoothing, at_least=0.0)
    what = f"hold {float(weight[0, 0]):g} N"
    return max_scale(C, a, b, copter.max_thrusts, what=what, smoothing=smoothing)


@checked(load=())
def rotor_out_margins(copter: Multicopter, *, load: float | Tensor = 0.0) -> Tensor:
    """Largest weight that can be held without each rotor in turn, yaw free, over the weight.

    At 1 or more the vehicle stays up, level in roll and pitch, while it spins about the vertical.

    Args:
        copter: The vehicle.
        load: Weight carried at the center of mass [N].

    Returns:
        (n_rotors,) [-].

    Gradients: mass, positions, directions, torque_ratios, max_thrusts, load.
    """
    C = torch.cat([_lift(copter), copter.torque_matrix[:2]])
    a = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    margins = []
    for out in range(copter.num_rotors):
        rest = [i for i in range(copter.num_rotors) if i != out]
        limits = copter.max_thrusts[rest]
        held = max_scale(C[:, rest], a, torch.zeros_like(a), limits, what="hover without a rotor")
        margins.append(held / (copter.weight + load))
    return torch.stack(margins)


@checked(A=("n", "n"))
def response_time(A: Tensor, B: Tensor, K: Tensor, *, within: float = math.exp(-1.0)) -> Tensor:
    """Time in which the slowest mode of x' = (A - B K) x falls to a share of its start.

    Args:
        A: State matrix, (n, n) float64 [1/s].
        B: (n, m) float64.
        K: (m, n) float64.
        within: The share: 1/e gives the slowest time constant, 0.02 the settling time to 2 %.

    Returns:
        () [s].

    Raises:
        TypeError, ValueError: wrong types or shapes, or ``within`` not in (0, 1).
        DiffsimError: the closed loop is not stable.

    Gradients: A, B, K; where several modes are equally slow, that of one of them.
    """
    A = require("A", A, ("n", "n"))
    B = require("B", B, (A.shape[0], "m"))
    K = require("K", K, (B.shape[1], A.shape[0]))
    within = require_number("within", within, above=0.0, below=1.0)
    slowest = torch.linalg.eigvals(A - B @ K).real.max()
    if anywhere(~(slowest < 0.0)):
        raise DiffsimError(
            f"the closed loop is not stable: a mode with real part "
            f"{float(values_of(slowest).max()):g} 1/s; "
            "take K from lqr(A, B, Q, R)"
        )
    return math.log(within) / slowest


def _lift(copter: Multicopter) -> Tensor:
    return -copter.force_matrix[2:3]


def _corners() -> Tensor:
    return torch.tensor(list(itertools.product([-1.0, 1.0], repeat=3)), dtype=torch.float64)


def _require_box(torque: Tensor | tuple[float, float, float]) -> Tensor:
    box = require("torque", as_array("torque", torque), (3,))
    require_unmapped(torque=box)
    return require_range("torque", box, at_least=0.0, hint="unit is N m")
