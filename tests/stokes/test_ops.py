"""Fields of the named tuples are the arguments of the ops, in their order."""

import pytest

from diffsim.copter import _ops_flight, _ops_hover
from diffsim.stokes import _ops_flow


def arguments(op) -> tuple[str, ...]:
    return tuple(argument.name for argument in op._opoverload._schema.arguments)


FLOW, FLIGHT, HOVER = _ops_flow.FlowInputs, _ops_flight.FlightInputs, _ops_hover.HoverProblem


@pytest.mark.parametrize(
    ("op", "fields"),
    [
        (_ops_flow.stokes_flow, FLOW._fields),
        (_ops_flight.flight, FLIGHT._fields),
        (_ops_hover.hover, HOVER._fields),
        (_ops_hover.hover_vjp, HOVER._fields + _ops_hover.HoverSolution._fields),
    ],
)
def test_ops_begin_with_their_inputs(op, fields):
    assert arguments(op)[: len(fields)] == fields


@pytest.mark.parametrize(
    ("op", "first", "fields"),
    [
        (_ops_flow.stokes_flow_vjp, "phi", FLOW._fields),
        (_ops_flight.flight_vjp, "start", FLIGHT._fields),
    ],
)
def test_adjoints_take_the_same_inputs(op, first, fields):
    start = arguments(op).index(first)
    assert arguments(op)[start : start + len(fields)] == fields


def test_flights_end_with_their_settings():
    fields = _ops_flight.FlightSettings._fields
    assert arguments(_ops_flight.flight)[-len(fields) :] == fields
