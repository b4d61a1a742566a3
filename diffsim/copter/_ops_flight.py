"""Flight of multicopters and its adjoint as torch custom ops.

Every input is (batch or 1, steps or 1, width) float64: a leading one shares a row between vehicles,
a second one between control steps. See csrc/kernels/copter/flight.h.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.compiled import core

BODY: int = core.FLIGHT_BODY
MAX_ROTORS: int = core.FLIGHT_MAX_ROTORS
EFFECTS = (
    "motor_lag",
    "thrust_curve",
    "rotor_drag",
    "body_drag",
    "ground_effect",
    "interference",
    "battery",
)


@torch.compiler.assume_constant_result
def fields(num_rotors: int) -> list[tuple[str, int]]:
    """Names and sizes of the parameters of one vehicle, in the order of their row."""
    return core.flight_fields(num_rotors)


def _widths(num_rotors: int, feedback: bool) -> dict[str, int]:
    """Width of every input; those of the feedback are absent without it."""
    widths = {
        "start": BODY + num_rotors,
        "feed_forward": num_rotors,
        "wind": 3,
        "parameters": sum(size for _, size in fields(num_rotors)),
    }
    return widths | ({"gain": 12 * num_rotors, "reference": 12} if feedback else {})


def _once(name: str) -> bool:
    """Whether an input has one row per vehicle rather than one per step."""
    return name in ("start", "gain", "parameters")


def _arrays(inputs: dict[str, Tensor], batch: int, steps: int, num_rotors: int) -> object:
    feedback = inputs["gain"].numel() > 0
    arrays = core.FlightArrays()
    for name, width in _widths(num_rotors, feedback).items():
        value = inputs[name]
        want = f"({batch} or 1, {1 if _once(name) else f'{steps} or 1'}, {width})"
        fits = (
            value.dim() == 3
            and value.shape[0] in (1, batch)
            and value.shape[1] in ((1,) if _once(name) else (1, steps))
            and value.shape[2] == width
        )
        if not fits or value.dtype != torch.float64 or not value.is_contiguous():
            raise ValueError(
                f"{name} must be contiguous float64 of shape {want}, got {value.dtype} of shape "
                f"{tuple(value.shape)}"
            )
        row = getattr(arrays, name)
        row.address = value.data_ptr()
        row.step_stride = width if value.shape[1] > 1 else 0
        row.vehicle_stride = value.shape[1] * width if value.shape[0] > 1 else 0
    return arrays


def _options(dt: float, gravity: float, substeps: int, effects: str, feedback: bool) -> object:
    options = core.FlightOptions()
    options.dt, options.gravity, options.substeps = dt, gravity, substeps
    options.feedback = feedback
    for name in filter(None, effects.split(",")):
        setattr(options, name, True)
    return options


@torch.library.custom_op("diffsim::flight", mutates_args=())
def flight(
    start: Tensor,
    feed_forward: Tensor,
    gain: Tensor,
    reference: Tensor,
    wind: Tensor,
    parameters: Tensor,
    batch: int,
    steps: int,
    dt: float,
    gravity: float,
    substeps: int,
    effects: str,
    num_threads: int,
) -> Tensor:
    """Records (batch, steps + 1, BODY + num_rotors) of a flight; record 0 is the start.

    Args:
        start: Width BODY + num_rotors.
        feed_forward: Width num_rotors [N].
        gain: Width 12 num_rotors; empty without feedback.
        reference: Width 12; empty without feedback.
        wind: Width 3 [m/s].
        parameters: As ``fields`` says.
        batch: Number of vehicles.
        steps: Number of control steps.
        dt: Integration step [s].
        gravity: [m/s^2].
        substeps: Integration steps per control step.
        effects: Those of ``EFFECTS`` that are there, separated by commas.
        num_threads: Threads of the kernel.
    """
    num_rotors = feed_forward.shape[-1]
    inputs = _named(start, feed_forward, gain, reference, wind, parameters)
    records = start.new_empty(batch, steps + 1, BODY + num_rotors)
    core.flight_rollout(
        num_rotors,
        batch,
        steps,
        _options(dt, gravity, substeps, effects, gain.numel() > 0),
        _arrays(inputs, batch, steps, num_rotors),
        records.data_ptr(),
        num_threads,
    )
    return records


@flight.register_fake
def _(start, feed_forward, gain, reference, wind, parameters, batch, steps, *args):
    return start.new_empty(batch, steps + 1, BODY + feed_forward.shape[-1])


@torch.library.custom_op("diffsim::flight_vjp", mutates_args=())
def flight_vjp(
    grad_records: Tensor,
    records: Tensor,
    start: Tensor,
    feed_forward: Tensor,
    gain: Tensor,
    reference: Tensor,
    wind: Tensor,
    parameters: Tensor,
    dt: float,
    gravity: float,
    substeps: int,
    effects: str,
    num_threads: int,
) -> list[Tensor]:
    """Adjoint of :func:`flight`: gradients of its six tensors."""
    num_rotors = feed_forward.shape[-1]
    batch, steps = records.shape[0], records.shape[1] - 1
    if grad_records.shape != records.shape or records.shape[2] != BODY + num_rotors:
        raise ValueError(
            f"records and grad_records must have shape ({batch}, {steps + 1}, "
            f"{BODY + num_rotors}), got {tuple(records.shape)} and {tuple(grad_records.shape)}"
        )
    grad_records, records = grad_records.contiguous(), records.contiguous()
    inputs = _named(start, feed_forward, gain, reference, wind, parameters)
    arrays = _arrays(inputs, batch, steps, num_rotors)
    groups = -(-batch // core.FLIGHT_GROUP)  # vehicles that share a row have one gradient per group
    rows = {
        name: value.new_zeros(groups, *value.shape[1:])
        if value.shape[0] == 1
        else torch.zeros_like(value)
        for name, value in inputs.items()
    }
    grads = core.FlightArrays()
    for name, value in rows.items():
        row = getattr(grads, name)
        row.address = value.data_ptr()
        row.step_stride = value.shape[2] if value.shape[1] > 1 else 0
        row.vehicle_stride = value.shape[1] * value.shape[2]
    core.flight_rollout_vjp(
        num_rotors,
        batch,
        steps,
        _options(dt, gravity, substeps, effects, gain.numel() > 0),
        arrays,
        records.data_ptr(),
        grad_records.data_ptr(),
        grads,
        num_threads,
    )
    return [
        rows[name].sum(0, keepdim=True) if value.shape[0] == 1 else rows[name]
        for name, value in inputs.items()
    ]


@flight_vjp.register_fake
def _(grad_records, records, start, feed_forward, gain, reference, wind, parameters, *args):
    inputs = (start, feed_forward, gain, reference, wind, parameters)
    return [torch.empty_like(value) for value in inputs]


def _named(
    start: Tensor,
    feed_forward: Tensor,
    gain: Tensor,
    reference: Tensor,
    wind: Tensor,
    parameters: Tensor,
) -> dict[str, Tensor]:
    return {
        "start": start,
        "feed_forward": feed_forward,
        "gain": gain,
        "reference": reference,
        "wind": wind,
        "parameters": parameters,
    }


def _setup_context(ctx, inputs, output):
    *tensors, _, _, dt, gravity, substeps, effects, num_threads = inputs
    ctx.save_for_backward(output, *tensors)
    ctx.settings = (dt, gravity, substeps, effects, num_threads)


def _backward(ctx, grad_records):
    grads = flight_vjp(grad_records, *ctx.saved_tensors, *ctx.settings)
    return (*grads, *(None,) * 7)


flight.register_autograd(_backward, setup_context=_setup_context)
