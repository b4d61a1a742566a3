"""Dimensionless hover thrusts as torch custom ops; see ``csrc/kernels/copter/hover.h``."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.layer import custom_op, directions_of, make_first_order, make_layer

INFO = ("status", "rank", "free_rank", "num_iters")
FEASIBLE: float = core.HOVER_FEASIBLE
"""Residual below which thrusts hover."""
STATUSES = ("optimal", "infeasible", "rank_deficient", "not_converged")


class HoverProblem(NamedTuple):
    """A batch of dimensionless hover problems; also the gradients of these.

    Attributes:
        force: M_f over the number of rotors, (batch, 3, n_rotors) [-].
        torque: M_t over the same and a mean lever, (batch, 3, n_rotors) [-].
        weights: h of the effort, mean 1, (batch, n_rotors) [-].
        upper: Largest thrusts in shares of the weight per rotor, (batch, n_rotors) [-].
    """

    force: Tensor
    torque: Tensor
    weights: Tensor
    upper: Tensor


class HoverSolution(NamedTuple):
    """What the solver returns.

    Attributes:
        thrusts: Thrusts in shares of the weight per rotor, (batch, n_rotors) [-].
        multipliers: Multipliers of lift and the three torques, (batch, 4); no gradient.
        state: -1 at the lower, 1 at the upper bound, else 0, (batch, n_rotors) int64.
        info: ``INFO``, (batch, 4) int64.
    """

    thrusts: Tensor
    multipliers: Tensor
    state: Tensor
    info: Tensor


def solve(problem: HoverProblem, *, barrier: float, num_threads: int) -> HoverSolution:
    """Thrusts of least effort; ``barrier`` weighs the logarithms of the distances to the bounds."""
    return HoverSolution(
        *hover_layer(**problem._asdict(), barrier=barrier, num_threads=num_threads)
    )


def _addresses(tensors: HoverProblem | HoverSolution, prefix: str = "") -> dict[str, int]:
    return {prefix + name: tensor.data_ptr() for name, tensor in tensors._asdict().items()}


def _check(name: str, value: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """What the kernels rely on; hover.py beside it has said it to the user already."""
    if value.dtype != dtype or value.device.type != "cpu" or value.shape != shape:
        raise ValueError(
            f"{name} must be a {dtype} CPU tensor of shape {shape}, got {value.dtype} on "
            f"{value.device} of shape {tuple(value.shape)}"
        )
    return value.contiguous()


def _check_problem(problem: HoverProblem) -> HoverProblem:
    batch, _, n = problem.force.shape
    return HoverProblem(
        force=_check("force", problem.force, (batch, 3, n), torch.float64),
        torque=_check("torque", problem.torque, (batch, 3, n), torch.float64),
        weights=_check("weights", problem.weights, (batch, n), torch.float64),
        upper=_check("upper", problem.upper, (batch, n), torch.float64),
    )


def _checked_solution(solution: HoverSolution, problem: HoverProblem) -> HoverSolution:
    batch, _, n = problem.force.shape
    return HoverSolution(
        thrusts=_check("thrusts", solution.thrusts, (batch, n), torch.float64),
        multipliers=_check("multipliers", solution.multipliers, (batch, 4), torch.float64),
        state=_check("state", solution.state, (batch, n), torch.int64),
        info=_check("info", solution.info, (batch, len(INFO)), torch.int64),
    )


@custom_op("diffsim::hover")
def hover(
    force: Tensor, torque: Tensor, weights: Tensor, upper: Tensor, barrier: float, num_threads: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """``HoverSolution`` of a ``HoverProblem``."""
    problem = _check_problem(HoverProblem(force, torque, weights, upper))
    batch, _, n = force.shape
    solution = HoverSolution(
        thrusts=force.new_empty(batch, n),
        multipliers=force.new_empty(batch, 4),
        state=torch.empty(batch, n, dtype=torch.int64),
        info=torch.empty(batch, len(INFO), dtype=torch.int64),
    )
    core.hover(
        **_addresses(problem),
        **_addresses(solution),
        barrier=barrier,
        batch=batch,
        num_rotors=n,
        num_threads=num_threads,
    )
    return solution


@hover.register_fake
def _(
    force: Tensor, torque: Tensor, weights: Tensor, upper: Tensor, barrier: float, num_threads: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    batch, _, n = force.shape
    state = force.new_empty(batch, n, dtype=torch.int64)
    info = force.new_empty(batch, len(INFO), dtype=torch.int64)
    return force.new_empty(batch, n), force.new_empty(batch, 4), state, info


@custom_op("diffsim::hover_vjp")
def hover_vjp(
    force: Tensor,
    torque: Tensor,
    weights: Tensor,
    upper: Tensor,
    thrusts: Tensor,
    multipliers: Tensor,
    state: Tensor,
    info: Tensor,
    grad_thrusts: Tensor,
    barrier: float,
    num_threads: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradients of a ``HoverProblem`` from its ``HoverSolution`` and dL/dthrusts."""
    problem = _check_problem(HoverProblem(force, torque, weights, upper))
    batch, _, n = force.shape
    solution = _checked_solution(HoverSolution(thrusts, multipliers, state, info), problem)
    grad_thrusts = _check("grad_thrusts", grad_thrusts, (batch, n), torch.float64)
    # not empty_like: the problem may be an expanded view, the kernel writes densely
    grads = HoverProblem(*(torch.empty(t.shape, dtype=torch.float64) for t in problem))
    core.hover_vjp(
        **_addresses(problem),
        **_addresses(solution),
        grad_thrusts=grad_thrusts.data_ptr(),
        **_addresses(grads, "grad_"),
        barrier=barrier,
        batch=batch,
        num_rotors=n,
        num_threads=num_threads,
    )
    return grads


@hover_vjp.register_fake
def _(
    force: Tensor, torque: Tensor, weights: Tensor, upper: Tensor, *_rest: Any
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return (
        force.new_empty(force.shape),
        force.new_empty(torque.shape),
        force.new_empty(weights.shape),
        force.new_empty(upper.shape),
    )


def _setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    *problem, barrier, num_threads = inputs
    ctx.save_for_backward(*problem, *output)
    ctx.mark_non_differentiable(*output[1:])
    ctx.options = {"barrier": barrier, "num_threads": num_threads}


# The KKT system of the free rotors, derived in csrc/kernels/copter/hover_adjoint.cpp.
def _backward(ctx: Any, grad_thrusts: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
    count = len(HoverProblem._fields)
    problem = HoverProblem(*ctx.saved_tensors[:count])
    solution = HoverSolution(*ctx.saved_tensors[count:])
    grads = hover_vjp_layer(
        **problem._asdict(),
        **solution._asdict(),
        grad_thrusts=grad_thrusts.contiguous(),
        **ctx.options,
    )
    return (*grads, None, None)


@custom_op("diffsim::hover_jvp")
def hover_jvp(
    force: Tensor,
    torque: Tensor,
    weights: Tensor,
    upper: Tensor,
    thrusts: Tensor,
    multipliers: Tensor,
    state: Tensor,
    info: Tensor,
    d_force: Tensor,
    d_torque: Tensor,
    d_weights: Tensor,
    d_upper: Tensor,
    barrier: float,
    num_threads: int,
) -> Tensor:
    """Thrusts along one direction in a ``HoverProblem``, from its ``HoverSolution``."""
    problem = _check_problem(HoverProblem(force, torque, weights, upper))
    directions = _check_problem(HoverProblem(d_force, d_torque, d_weights, d_upper))
    solution = _checked_solution(HoverSolution(thrusts, multipliers, state, info), problem)
    d_thrusts = force.new_empty(thrusts.shape)
    core.hover_tangent(
        **_addresses(problem),
        **_addresses(solution),
        **_addresses(directions, "d_"),
        d_thrusts=d_thrusts.data_ptr(),
        barrier=barrier,
        batch=force.shape[0],
        num_rotors=force.shape[2],
        num_threads=num_threads,
    )
    return d_thrusts


@hover_jvp.register_fake
def _(force: Tensor, torque: Tensor, weights: Tensor, *_rest: Any) -> Tensor:
    return force.new_empty(weights.shape)


def _tangent(ctx: Any, *moved: Tensor | None) -> tuple[Tensor | None, ...]:
    count = len(HoverProblem._fields)
    problem = HoverProblem(*ctx.saved_tensors[:count])
    solution = HoverSolution(*ctx.saved_tensors[count:])
    directions = directions_of(problem._asdict(), moved)
    d_thrusts = hover_jvp_layer(
        **problem._asdict(), **solution._asdict(), **directions, **ctx.options
    )
    return d_thrusts, None, None, None


hover_vjp_layer = make_first_order(hover_vjp)
hover_jvp_layer = make_first_order(hover_jvp)
hover_layer = make_layer(hover, setup=_setup, backward=_backward, tangent=_tangent)
