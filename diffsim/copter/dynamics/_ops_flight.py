"""Flight of multicopters and its adjoint as torch custom ops.

Every input is (batch or 1, steps or 1, width) float64: a leading one shares a row between vehicles,
a second one between control steps. See csrc/kernels/copter/flight.h. Ops take flat arguments;
:class:`FlightInputs` and :class:`FlightSettings` name them, in the order of the ops.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.layer import custom_op, directions_of, make_first_order, make_layer

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


class FlightInputs(NamedTuple):
    """What a flight depends on, (batch or 1, steps or 1, width) each; also the gradients of these.

    Attributes:
        start: Width BODY + num_rotors.
        feed_forward: Width num_rotors [N].
        gain: Width 12 num_rotors; empty without feedback.
        reference: Width 12; empty without feedback.
        wind: Width 3 [m/s].
        parameters: Parameters of the vehicles in the order of ``fields``.
    """

    start: Tensor
    feed_forward: Tensor
    gain: Tensor
    reference: Tensor
    wind: Tensor
    parameters: Tensor

    @property
    def num_rotors(self) -> int:
        """Rotors of every vehicle."""
        return self.feed_forward.shape[-1]

    @property
    def feedback(self) -> bool:
        """Whether thrusts depend on the state."""
        return self.gain.numel() > 0


class FlightSettings(NamedTuple):
    """How a flight is integrated.

    Attributes:
        dt: Integration step [s].
        gravity: Strength of gravity [m/s^2].
        substeps: Integration steps per control step.
        effects: Names of the effects that are modeled, out of ``EFFECTS``, separated by commas;
            ``free_thrusts`` among them: commands are not clamped.
        num_threads: Threads of the kernel.
    """

    dt: float
    gravity: float
    substeps: int
    effects: str
    num_threads: int


def rollout(
    inputs: FlightInputs, settings: FlightSettings, *, batch: int, steps: int, end_alone: bool
) -> Tensor:
    """Records (batch, steps + 1, BODY + num_rotors) of a flight; record 0 is the start.

    With ``end_alone`` (batch, 1, BODY + num_rotors): the last ones, and no memory for the others.
    """
    contiguous = {name: value.contiguous() for name, value in inputs._asdict().items()}
    sizes = {"batch": batch, "steps": steps, "end_alone": end_alone}
    return flight_layer(**contiguous, **sizes, **settings._asdict())


# known before PyTorch's compiler looks, which cannot follow the core
_FIELDS: dict[int, list[tuple[str, int]]] = {
    n: core.flight_fields(n) for n in range(1, MAX_ROTORS + 1)
}


def fields(num_rotors: int) -> list[tuple[str, int]]:
    """Names and sizes of the parameters of one vehicle, in the order of their row."""
    return _FIELDS[num_rotors]


def parameter_width(num_rotors: int) -> int:
    """Numbers in the row of parameters of one vehicle."""
    return sum(size for _, size in _FIELDS[num_rotors])


def _widths(inputs: FlightInputs) -> dict[str, int]:
    """Width of every input; those of the feedback are absent without it."""
    num_rotors = inputs.num_rotors
    widths = {
        "start": BODY + num_rotors,
        "feed_forward": num_rotors,
        "wind": 3,
        "parameters": parameter_width(num_rotors),
    }
    return widths | ({"gain": 12 * num_rotors, "reference": 12} if inputs.feedback else {})


def _once(name: str) -> bool:
    """Whether an input has one row per vehicle rather than one per step."""
    return name in ("start", "gain", "parameters")


def _arrays(inputs: FlightInputs, batch: int, steps: int) -> object:
    arrays = core.FlightArrays()
    for name, width in _widths(inputs).items():
        value: Tensor = getattr(inputs, name)
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


def _gradient_arrays(grads: FlightInputs) -> object:
    arrays = core.FlightArrays()
    for name, value in grads._asdict().items():
        row = getattr(arrays, name)
        row.address = value.data_ptr()
        row.step_stride = value.shape[2] if value.shape[1] > 1 else 0
        row.vehicle_stride = value.shape[1] * value.shape[2]
    return arrays


def _options(
    dt: float, gravity: float, substeps: int, effects: str, feedback: bool, end_alone: bool
) -> object:
    options = core.FlightOptions()
    options.end_alone = end_alone
    options.dt, options.gravity, options.substeps = dt, gravity, substeps
    options.feedback = feedback
    for name in filter(None, effects.split(",")):
        setattr(options, name, True)
    return options


def _num_records(steps: int, end_alone: bool) -> int:
    """Records that are kept of every vehicle."""
    return 1 if end_alone else steps + 1


@custom_op("diffsim::flight")
def flight(
    start: Tensor,
    feed_forward: Tensor,
    gain: Tensor,
    reference: Tensor,
    wind: Tensor,
    parameters: Tensor,
    batch: int,
    steps: int,
    end_alone: bool,
    dt: float,
    gravity: float,
    substeps: int,
    effects: str,
    num_threads: int,
) -> Tensor:
    """Records of ``FlightInputs`` under ``FlightSettings``; see :func:`rollout`."""
    inputs = FlightInputs(start, feed_forward, gain, reference, wind, parameters)
    records = start.new_empty(batch, _num_records(steps, end_alone), BODY + inputs.num_rotors)
    core.flight_rollout(
        num_rotors=inputs.num_rotors,
        batch=batch,
        steps=steps,
        options=_options(dt, gravity, substeps, effects, inputs.feedback, end_alone),
        inputs=_arrays(inputs, batch, steps),
        records=records.data_ptr(),
        num_threads=num_threads,
    )
    return records


@flight.register_fake
def _(start, feed_forward, gain, reference, wind, parameters, batch, steps, end_alone, *args):
    return start.new_empty(batch, _num_records(steps, end_alone), BODY + feed_forward.shape[-1])


@custom_op("diffsim::flight_vjp")
def flight_vjp(
    grad_records: Tensor,
    records: Tensor,
    start: Tensor,
    feed_forward: Tensor,
    gain: Tensor,
    reference: Tensor,
    wind: Tensor,
    parameters: Tensor,
    end_alone: bool,
    dt: float,
    gravity: float,
    substeps: int,
    effects: str,
    num_threads: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Adjoint of :func:`flight`: gradients of ``FlightInputs``; ``records`` are all of them."""
    inputs = FlightInputs(start, feed_forward, gain, reference, wind, parameters)
    batch, steps = records.shape[0], records.shape[1] - 1
    width = BODY + inputs.num_rotors
    wanted = (batch, _num_records(steps, end_alone), width)
    if grad_records.shape != wanted or records.shape[2] != width:
        raise ValueError(
            f"records must have shape ({batch}, {steps + 1}, {width}), grad_records {wanted}, got "
            f"{tuple(records.shape)} and {tuple(grad_records.shape)}"
        )
    grad_records, records = grad_records.contiguous(), records.contiguous()
    groups = -(-batch // core.FLIGHT_GROUP)  # vehicles that share a row have one gradient per group
    grads = FlightInputs(
        *(
            value.new_zeros(groups, *value.shape[1:])
            if value.shape[0] == 1
            else torch.zeros_like(value)
            for value in inputs
        )
    )
    core.flight_rollout_vjp(
        num_rotors=inputs.num_rotors,
        batch=batch,
        steps=steps,
        options=_options(dt, gravity, substeps, effects, inputs.feedback, end_alone),
        inputs=_arrays(inputs, batch, steps),
        records=records.data_ptr(),
        grad_records=grad_records.data_ptr(),
        grads=_gradient_arrays(grads),
        num_threads=num_threads,
    )
    return FlightInputs(
        *(
            grad.sum(0, keepdim=True) if value.shape[0] == 1 else grad
            for grad, value in zip(grads, inputs, strict=True)
        )
    )


@flight_vjp.register_fake
def _(grad_records, records, *args):
    inputs = args[: len(FlightInputs._fields)]
    return tuple(torch.empty_like(value) for value in inputs)


def _setup_context(ctx, inputs, output):
    count = len(FlightInputs._fields)
    ctx.batch, ctx.steps, ctx.end_alone, *settings = inputs[count:]
    ctx.settings = FlightSettings(*settings)
    ctx.save_for_backward(output, *inputs[:count])


def _backward(ctx, grad_records):
    records, *saved = ctx.saved_tensors
    inputs = FlightInputs(*saved)._asdict()
    settings = ctx.settings._asdict()
    if ctx.end_alone:  # the records that nobody kept, once more
        sizes = {"batch": ctx.batch, "steps": ctx.steps, "end_alone": False}
        with torch.no_grad():
            records = flight_layer(**inputs, **sizes, **settings)
    grads = flight_vjp_layer(
        grad_records=grad_records, records=records, **inputs, end_alone=ctx.end_alone, **settings
    )
    return (*grads, *(None,) * 8)


@custom_op("diffsim::flight_jvp")
def flight_jvp(
    start: Tensor,
    feed_forward: Tensor,
    gain: Tensor,
    reference: Tensor,
    wind: Tensor,
    parameters: Tensor,
    d_start: Tensor,
    d_feed_forward: Tensor,
    d_gain: Tensor,
    d_reference: Tensor,
    d_wind: Tensor,
    d_parameters: Tensor,
    batch: int,
    steps: int,
    end_alone: bool,
    dt: float,
    gravity: float,
    substeps: int,
    effects: str,
    num_threads: int,
) -> Tensor:
    """Records of :func:`flight` along one direction in ``FlightInputs``."""
    inputs = FlightInputs(start, feed_forward, gain, reference, wind, parameters)
    given = d_start, d_feed_forward, d_gain, d_reference, d_wind, d_parameters
    directions = FlightInputs(*(direction.contiguous() for direction in given))
    rates = start.new_empty(batch, _num_records(steps, end_alone), BODY + inputs.num_rotors)
    core.flight_rollout_tangent(
        num_rotors=inputs.num_rotors,
        batch=batch,
        steps=steps,
        options=_options(dt, gravity, substeps, effects, inputs.feedback, end_alone),
        inputs=_arrays(inputs, batch, steps),
        directions=_arrays(directions, batch, steps),
        rates=rates.data_ptr(),
        num_threads=num_threads,
    )
    return rates


@flight_jvp.register_fake
def _(start, feed_forward, *args):
    batch, steps, end_alone = args[10:13]
    return start.new_empty(batch, _num_records(steps, end_alone), BODY + feed_forward.shape[-1])


def _tangent(ctx, *moved):
    _, *saved = ctx.saved_tensors
    inputs = FlightInputs(*saved)
    return flight_jvp_layer(
        **inputs._asdict(),
        **directions_of(inputs._asdict(), moved),
        batch=ctx.batch,
        steps=ctx.steps,
        end_alone=ctx.end_alone,
        **ctx.settings._asdict(),
    )


flight_vjp_layer = make_first_order(flight_vjp)
flight_jvp_layer = make_first_order(flight_jvp)
flight_layer = make_layer(flight, setup=_setup_context, backward=_backward, tangent=_tangent)
