"""Flight of multicopters and its adjoint as torch custom ops.

Every input is (batch or 1, steps or 1, width) float64: a leading one shares a row between vehicles,
a second one between control steps. See csrc/kernels/copter/flight.h. Ops take flat arguments;
:class:`FlightInputs` and :class:`FlightSettings` name them, in the order of the ops.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.ops import Call, Op, array

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
    """What a flight depends on, (batch or 1, steps or 1, width) each; also their gradients."""

    start: Tensor  # width BODY + num_rotors
    feed_forward: Tensor  # width num_rotors [N]
    gain: Tensor  # width 12 num_rotors; empty without feedback
    reference: Tensor  # width 12; empty without feedback
    wind: Tensor  # width 3 [m/s]
    parameters: Tensor  # parameters of the vehicles in the order of ``fields``

    @property
    def num_rotors(self) -> int:
        """Rotors of every vehicle."""
        return self.feed_forward.shape[-1]

    @property
    def feedback(self) -> bool:
        """Whether thrusts depend on the state."""
        return self.gain.numel() > 0


class FlightSettings(NamedTuple):
    """How a flight is integrated."""

    dt: float  # integration step [s]
    gravity: float  # strength of gravity [m/s^2]
    substeps: int  # integration steps per control step
    # names of the effects that are modeled, out of ``EFFECTS``, separated by commas;
    # ``free_thrusts`` among them: commands are not clamped
    effects: str
    num_threads: int  # threads of the kernel


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


def _sizes(call: Call) -> dict[str, int]:
    num_rotors = call["feed_forward"].shape[-1]
    return {
        "num_rotors": num_rotors,
        "state": BODY + num_rotors,
        "gains": 12 * num_rotors,
        "fields": parameter_width(int(num_rotors)),
        "kept": 1 if call.options["end_alone"] else call.options["steps"] + 1,
    }


def _arrays(call: Call, prefix: str = "") -> object:
    """Rows of inputs, of their gradients or of their directions, and how far apart they lie."""
    arrays = core.FlightArrays()
    for name in FlightInputs._fields:
        value = call[prefix + name]
        if not value.numel():  # no feedback
            continue
        row = getattr(arrays, name)
        row.address = value.data_ptr()
        row.step_stride = value.shape[2] if value.shape[1] > 1 else 0
        row.vehicle_stride = value.shape[1] * value.shape[2] if value.shape[0] > 1 else 0
    return arrays


def _common(call: Call, **changed: bool) -> dict[str, object]:
    """What all kernels take."""
    options = core.FlightOptions()
    options.feedback = call["gain"].numel() > 0
    for name in ("end_alone", "dt", "gravity", "substeps"):
        setattr(options, name, (call.options | changed)[name])
    for name in filter(None, call.options["effects"].split(",")):
        setattr(options, name, True)
    sizes = {name: call.sizes[name] for name in ("num_rotors", "batch", "steps", "num_threads")}
    return {"options": options, "inputs": _arrays(call), **sizes}


def _rollout(call: Call) -> None:
    core.flight_rollout(**_common(call), **call.addresses("records"))


def _adjoint(call: Call) -> None:
    records = call["records"]
    if call.options["end_alone"]:  # the records that nobody kept, once more
        sizes = call.sizes
        records = records.new_empty(sizes["batch"], sizes["steps"] + 1, sizes["state"])
        core.flight_rollout(**_common(call, end_alone=False), records=records.data_ptr())
    groups = -(-len(records) // core.FLIGHT_GROUP)
    shared = [f"grad_{name}" for name in FlightInputs._fields if len(call[name]) == 1]
    for name in shared:  # vehicles that share a row have one gradient per group
        call[name] = records.new_zeros(groups, *call[name].shape[1:])
    core.flight_rollout_vjp(
        **_common(call),
        records=records.data_ptr(),
        grad_records=call["grad_records"].data_ptr(),
        grads=_arrays(call, "grad_"),
    )
    for name in shared:
        call[name] = call[name].sum(0, keepdim=True)


def _tangent(call: Call) -> None:
    rates = call["d_records"].data_ptr()
    core.flight_rollout_tangent(**_common(call), directions=_arrays(call, "d_"), rates=rates)


# Records, state of every vehicle after every control step from the start on; with ``end_alone`` the
# last ones, and no memory for the others. An empty gain and reference: no feedback.
flight = Op(
    "flight",
    inputs={
        "start": array("batch?", 1, "state"),
        "feed_forward": array("batch?", "steps?", "num_rotors"),
        "gain": array("batch?", 1, "gains", optional=True),
        "reference": array("batch?", "steps?", 12, optional=True),
        "wind": array("batch?", "steps?", 3),
        "parameters": array("batch?", 1, "fields"),
    },
    outputs={"records": array("batch", "kept", "state")},
    options="int batch, int steps, bool end_alone, "
    "float dt, float gravity, int substeps, str effects, int num_threads",
    sizes=_sizes,
    reads=("records", *FlightInputs._fields),
    kernel=_rollout,
    adjoint=_adjoint,
    tangent=_tangent,
)


def rollout(
    inputs: FlightInputs, settings: FlightSettings, *, batch: int, steps: int, end_alone: bool
) -> Tensor:
    """Records (batch, steps + 1, BODY + num_rotors) of a flight; record 0 is the start.

    With ``end_alone`` (batch, 1, BODY + num_rotors): the last ones, and no memory for the others.
    """
    return flight(*inputs, batch, steps, end_alone, *settings)
