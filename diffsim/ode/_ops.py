"""Initial value problems as torch custom ops; see ``csrc/kernels/ode/integrate.h``."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.layer import custom_op, directions_of, make_layer
from diffsim.ode.in_torch import pull, push, solve

_PROBLEM = (
    *("rate_code", "reading_code", "rate_out", "reading_out", "constants"),
    *("times", "lower", "upper", "held"),
)
"""Tensors that describe a problem, by the names that the kernel has for them."""
_FORWARD = (*_PROBLEM, "num_steps", "num_threads", "start", "inputs", "parameters")
_BACKWARD = (
    *(*_PROBLEM, "num_steps", "num_threads", "inputs", "parameters", "states"),
    *("grad_readings", "grad_states"),
)

_ALONG = (*_FORWARD, "d_start", "d_inputs", "d_parameters")


def _by_name(
    names: tuple[str, ...], args: tuple[Any, ...], named: dict[str, Any]
) -> dict[str, Any]:
    """Arguments of an op as they are called; torch hands them on by place."""
    return dict(zip(names, args, strict=False)) | named


@custom_op("diffsim::ode_integrate")
def ode_integrate(
    rate_code: Tensor,
    reading_code: Tensor,
    rate_out: Tensor,
    reading_out: Tensor,
    constants: Tensor,
    times: Tensor,
    lower: Tensor,
    upper: Tensor,
    held: Tensor,
    num_steps: int,
    num_threads: int,
    start: Tensor,
    inputs: Tensor,
    parameters: Tensor,
) -> tuple[Tensor, Tensor]:
    """Readings (batch, num_samples, num_channels) and states (batch, num_samples, num_states)."""
    given = {k: v for k, v in locals().items() if k in _PROBLEM}
    problem, kept = _problem(given, num_steps, start, inputs, parameters)
    start, inputs, parameters = start.contiguous(), inputs.contiguous(), parameters.contiguous()
    readings = start.new_empty((len(start), len(times), len(reading_out)))
    states = start.new_empty((len(start), len(times), start.shape[1]))
    core.ode_integrate(
        problem,
        start=start.data_ptr(),
        inputs=inputs.data_ptr(),
        parameters=parameters.data_ptr(),
        readings=readings.data_ptr(),
        states=states.data_ptr(),
        num_threads=num_threads,
    )
    del kept
    return readings, states


@ode_integrate.register_fake
def _empty_answer(*args: Any, **named: Any) -> tuple[Tensor, Tensor]:
    given = _by_name(_FORWARD, args, named)
    start, shape = given["start"], (given["start"].shape[0], given["times"].shape[0])
    return (
        start.new_empty((*shape, given["reading_out"].shape[0])),
        start.new_empty((*shape, start.shape[1])),
    )


@custom_op("diffsim::ode_integrate_vjp")
def ode_integrate_vjp(
    rate_code: Tensor,
    reading_code: Tensor,
    rate_out: Tensor,
    reading_out: Tensor,
    constants: Tensor,
    times: Tensor,
    lower: Tensor,
    upper: Tensor,
    held: Tensor,
    num_steps: int,
    num_threads: int,
    inputs: Tensor,
    parameters: Tensor,
    states: Tensor,
    grad_readings: Tensor,
    grad_states: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """dL/d(start), dL/d(inputs) of every member, dL/d(parameters)."""
    given = {k: v for k, v in locals().items() if k in _PROBLEM}
    start = states[:, 0].contiguous()
    problem, kept = _problem(given, num_steps, start, inputs, parameters)
    inputs, parameters, states = inputs.contiguous(), parameters.contiguous(), states.contiguous()
    grad_readings, grad_states = grad_readings.contiguous(), grad_states.contiguous()
    grad_start = torch.empty_like(start)
    grad_inputs = start.new_empty((len(start), *inputs.shape[1:]))
    grad_parameters = torch.empty_like(parameters)
    core.ode_integrate_vjp(
        problem,
        inputs=inputs.data_ptr(),
        parameters=parameters.data_ptr(),
        states=states.data_ptr(),
        grad_readings=grad_readings.data_ptr(),
        grad_states=grad_states.data_ptr(),
        grad_start=grad_start.data_ptr(),
        grad_inputs=grad_inputs.data_ptr(),
        grad_parameters=grad_parameters.data_ptr(),
        num_threads=num_threads,
    )
    del kept
    return grad_start, grad_inputs, grad_parameters


@ode_integrate_vjp.register_fake
def _(*args: Any, **named: Any) -> tuple[Tensor, Tensor, Tensor]:
    given = _by_name(_BACKWARD, args, named)
    inputs, parameters, states = given["inputs"], given["parameters"], given["states"]
    return (
        states.new_empty((states.shape[0], states.shape[2])),
        states.new_empty((states.shape[0], *inputs.shape[1:])),
        parameters.new_empty(parameters.shape),
    )


@custom_op("diffsim::ode_integrate_jvp")
def ode_integrate_jvp(
    rate_code: Tensor,
    reading_code: Tensor,
    rate_out: Tensor,
    reading_out: Tensor,
    constants: Tensor,
    times: Tensor,
    lower: Tensor,
    upper: Tensor,
    held: Tensor,
    num_steps: int,
    num_threads: int,
    start: Tensor,
    inputs: Tensor,
    parameters: Tensor,
    d_start: Tensor,
    d_inputs: Tensor,
    d_parameters: Tensor,
) -> tuple[Tensor, Tensor]:
    """Readings and states along one direction of start, inputs and parameters."""
    given = {k: v for k, v in locals().items() if k in _PROBLEM}
    problem, kept = _problem(given, num_steps, start, inputs, parameters)
    values = [start, inputs, parameters, d_start, d_inputs, d_parameters]
    values = [value.contiguous() for value in values]
    if [v.shape for v in values[:3]] != [v.shape for v in values[3:]]:
        raise ValueError("directions must have the shapes of start, inputs and parameters")
    d_readings = start.new_empty((len(start), len(times), len(reading_out)))
    d_states = start.new_empty((len(start), len(times), start.shape[1]))
    core.ode_integrate_tangent(
        problem,
        *(value.data_ptr() for value in values),
        d_readings=d_readings.data_ptr(),
        d_states=d_states.data_ptr(),
        num_threads=num_threads,
    )
    del kept
    return d_readings, d_states


ode_integrate_jvp.register_fake(_empty_answer)  # directions come after what the op takes


def _setup(ctx: Any, args: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    given = dict(zip(_FORWARD, args, strict=True))
    ctx.options = {name: given.pop(name) for name in ("num_steps", "num_threads")}
    ctx.save_for_backward(*given.values(), output[1])


def _read_saved(ctx: Any) -> dict[str, Any]:
    """Arguments of the op by name, with the states."""
    names = [*(name for name in _FORWARD if name not in ctx.options), "states"]
    return dict(zip(names, ctx.saved_tensors, strict=True)) | ctx.options


def _backward(ctx: Any, grad_readings: Tensor, grad_states: Tensor) -> tuple[Any, ...]:
    given = _read_saved(ctx)
    del given["start"]
    grads = ode_integrate_vjp_layer(
        **given, grad_readings=grad_readings.contiguous(), grad_states=grad_states.contiguous()
    )
    grad_start, grad_inputs, grad_parameters = grads
    if len(given["inputs"]) == 1:
        grad_inputs = grad_inputs.sum(0, keepdim=True)
    return (*(None,) * (len(_FORWARD) - 3), grad_start, grad_inputs, grad_parameters)


def _tangent(ctx: Any, *moved: Any) -> tuple[Tensor, Tensor]:
    given = _read_saved(ctx)
    del given["states"]
    moving = {name: given[name] for name in _FORWARD[-3:]}
    return ode_integrate_jvp_layer(**given, **directions_of(moving, moved[-3:]))


def _setup_vjp(ctx: Any, args: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    _keep(ctx, _BACKWARD, args)


def _setup_jvp(ctx: Any, args: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    _keep(ctx, _ALONG, args)


def _keep(ctx: Any, names: tuple[str, ...], args: tuple[Any, ...]) -> None:
    given = dict(zip(names, args, strict=True))
    ctx.num_steps = given["num_steps"]
    ctx.problem = {name: given[name] for name in _PROBLEM}
    ctx.save_for_backward(*args[len(_PROBLEM) + 2 :])


def _vjp_of(ctx: Any) -> Callable[..., tuple[Tensor, ...]]:
    """The op of the adjoint as a function of what may be differentiated.

    It reads the first state alone: the others follow from it.
    """

    def gradients(
        inputs: Tensor, parameters: Tensor, states: Tensor, *cotangents: Tensor
    ) -> tuple[Tensor, ...]:
        at = (states[:, 0], inputs.expand(len(states), *inputs.shape[1:]), parameters)
        return pull(partial(solve, ctx.problem, ctx.num_steps), at, cotangents)

    return gradients


def _jvp_of(ctx: Any) -> Callable[..., tuple[Tensor, ...]]:
    """The op of the tangent as a function of what may be differentiated."""

    def tangents(*given: Tensor) -> tuple[Tensor, ...]:
        return push(partial(solve, ctx.problem, ctx.num_steps), given[:3], given[3:])

    return tangents


def _backward_by(function: Callable[..., Any]) -> Callable[..., tuple[Any, ...]]:
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Any, ...]:
        found = pull(function(ctx), ctx.saved_tensors, cotangents)
        return (*(None,) * (len(_PROBLEM) + 2), *found)

    return backward


def _tangent_by(function: Callable[..., Any]) -> Callable[..., tuple[Tensor, ...]]:
    def tangent(ctx: Any, *moved: Any) -> tuple[Tensor, ...]:
        at = ctx.saved_tensors
        directions = [
            torch.zeros_like(value) if direction is None else direction
            for value, direction in zip(at, moved[-len(at) :], strict=True)
        ]
        return push(function(ctx), at, tuple(directions))

    return tangent


ode_integrate_vjp_layer = make_layer(
    ode_integrate_vjp,
    setup=_setup_vjp,
    backward=_backward_by(_vjp_of),
    tangent=_tangent_by(_vjp_of),
)
ode_integrate_jvp_layer = make_layer(
    ode_integrate_jvp,
    setup=_setup_jvp,
    backward=_backward_by(_jvp_of),
    tangent=_tangent_by(_jvp_of),
)
ode_integrate_layer = make_layer(ode_integrate, setup=_setup, backward=_backward, tangent=_tangent)


def _problem(
    given: dict[str, Tensor], num_steps: int, start: Tensor, inputs: Tensor, parameters: Tensor
) -> tuple[Any, list[Tensor]]:
    """What the kernel reads, and the tensors that must live as long as it does."""
    kept = {name: given[name].contiguous() for name in _PROBLEM}
    p = core.OdeAddresses()
    for name, tensor in kept.items():
        setattr(p, name, tensor.data_ptr())
    p.num_rate_code, p.num_reading_code = len(kept["rate_code"]), len(kept["reading_code"])
    p.num_states, p.num_inputs = start.shape[1], inputs.shape[2]
    p.num_parameters, p.num_constants = parameters.shape[1], len(kept["constants"])
    p.num_channels, p.num_samples = len(kept["reading_out"]), len(kept["times"])
    p.num_steps, p.batch = num_steps, len(start)
    p.input_stride = 0 if len(inputs) == 1 else inputs[0].numel()
    return p, list(kept.values())
