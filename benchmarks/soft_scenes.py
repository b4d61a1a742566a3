"""The cantilever of thesis 4.1.5, its loss, and one timed forward and backward pass."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from benchmarks.harness import Seconds, timed
from diffsim import mesh, soft
from diffsim.core.errors import ConvergenceWarning

LENGTH, WIDTH = 0.32, 0.08  # [m]
MATERIAL: dict[str, Any] = {
    "youngs_modulus": 1e6,
    "poissons_ratio": 0.45,
    "density": 1e3,
}


def cantilever(
    kind: str = "hex",
    cells: Sequence[int] = (32, 8, 8),
    *,
    dt: float = 1e-2,
    material: str = "pd",
    volume_weight: str = "thesis",
    solver: soft.SolverOptions | None = None,
    **options: Any,
) -> soft.SoftBody:
    """A beam of 0.32 x 0.08 x 0.08 m along x, held at x = 0; 32 x 8 x 8 cells are 8,019 DoF.

    Args:
        kind: ``hex``, or ``tet`` for six tetrahedra in every cell.
        cells: Cells along x, y, z.
        dt: Time step [s].
        material, volume_weight: See :class:`diffsim.soft.Material`.
        solver: Solver options.
        **options: More arguments of :class:`diffsim.soft.SoftBody`, before those of MATERIAL.
    """
    make = {"hex": mesh.hex_box, "tet": mesh.tet_box}[kind]
    box = make(cells, (LENGTH, WIDTH, WIDTH))
    held = box.x_rest[:, 0] == 0
    return soft.SoftBody(
        box,
        dt=dt,
        element="standard",
        fixed=held,
        material=soft.Material(material, volume_weight=volume_weight),
        solver=solver,
        **{**MATERIAL, **options},
    )


def twisted(body: soft.SoftBody, degrees: float = 90.0) -> Tensor:
    """Rest positions turned about the axis, from 0 at x = 0 to ``degrees`` at the end [m]."""
    x, y, z = body.x_rest.unbind(-1)
    angle = math.radians(degrees) * x / LENGTH
    y, z = y - WIDTH / 2, z - WIDTH / 2
    return torch.stack(
        [
            x,
            WIDTH / 2 + y * torch.cos(angle) - z * torch.sin(angle),
            WIDTH / 2 + y * torch.sin(angle) + z * torch.cos(angle),
        ],
        dim=-1,
    )


def loss_weights(num_nodes: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Standard normal weights of positions [1/m] and velocities [s/m], (num_nodes, 3)."""
    generator = torch.Generator().manual_seed(seed)
    both = torch.randn(2, num_nodes, 3, generator=generator, dtype=torch.float64)
    return both[0], both[1]


def weighted_loss(state: soft.State) -> Tensor:
    """Random weighted sum of final positions and velocities; one per batch item [-]."""
    weight_x, weight_v = loss_weights(state.x.shape[-2])
    return (state.x * weight_x + state.v * weight_v).sum((-2, -1))


@dataclass(frozen=True)
class Pass:
    """One rollout and its gradient."""

    loss: float  # of the final state [-]
    grad: Tensor  # gradient to initial positions and velocities, (2, num_nodes, 3) [1/m, s/m]
    # forward, backward: times
    forward: Seconds
    backward: Seconds
    # steps, adjoints: statistics of the solves, in order of execution
    steps: list[soft.SolveStats]
    adjoints: list[soft.SolveStats]

    @property
    def total(self) -> float:
        """Wall time of forward and backward [s]."""
        return self.forward.wall + self.backward.wall

    @property
    def converged(self) -> bool:
        """Every solve met its tolerance."""
        return all(bool((s.converged == 1).all()) for s in (*self.steps, *self.adjoints))

    @property
    def factorized(self) -> bool:
        """Some solve factorized its tangent."""
        return any(bool((s.num_factorizations > 0).any()) for s in (*self.steps, *self.adjoints))

    def counts(self) -> dict[str, float]:
        """Iterations, solves with the constant factor and factorizations, mean per step."""
        names = ("num_iters", "num_solves", "num_factorizations")
        return {
            f"{kind}_{name.removeprefix('num_')}": mean([float(getattr(s, name)) for s in solves])
            for kind, solves in (("step", self.steps), ("adjoint", self.adjoints))
            for name in names
        }


def mean(values: Sequence[float]) -> float:
    """Mean, 0 of nothing (an explicit step solves nothing)."""
    return sum(values) / len(values) if values else 0.0


def rollout_loss(
    body: soft.SoftBody, num_steps: int, *, degrees: float = 90.0, **options: Any
) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Loss of a rollout from the twisted shape at rest, and the initial x and v it depends on.

    Args:
        body: The beam.
        num_steps: Number of steps.
        degrees: Twist of the initial shape.
        **options: More arguments of :func:`diffsim.soft.rollout`.
    """
    x = twisted(body, degrees).requires_grad_()
    v = torch.zeros_like(x, requires_grad=True)
    end = soft.rollout(body, soft.State(x, v), num_steps, **options).final
    return weighted_loss(end), (x, v)


def one_pass(body: soft.SoftBody, num_steps: int, **options: Any) -> Pass:
    """Forward and backward of :func:`rollout_loss`, timed."""
    return timed_pass(lambda: rollout_loss(body, num_steps, **options))


def timed_pass(forward: Callable[[], tuple[Tensor, tuple[Tensor, Tensor]]]) -> Pass:
    """Forward, which returns a loss and the leaves x and v of its graph, and backward."""
    with warnings.catch_warnings(), soft.record_stats() as solves:
        warnings.simplefilter("ignore", ConvergenceWarning)  # Pass.converged tells
        (loss, (x, v)), forward_time = timed(forward)
        _, backward_time = timed(loss.backward)
    assert x.grad is not None and v.grad is not None
    return Pass(
        loss=float(loss.detach()),
        grad=torch.stack([x.grad, v.grad]),
        forward=forward_time,
        backward=backward_time,
        steps=[s for s in solves if s.kind == "step"],
        adjoints=[s for s in solves if s.kind == "adjoint"],
    )
