"""Fields of the named tuples are the arguments of the ops, in their order."""

import pytest

from diffsim.copter.dynamics import _ops_flight, _ops_hover
from tests.helpers import op_arguments

FLIGHT, SETTINGS = _ops_flight.FlightInputs._fields, _ops_flight.FlightSettings._fields
HOVER = _ops_hover.HoverProblem._fields


@pytest.mark.parametrize(
    ("op", "fields"),
    [
        (_ops_flight.flight, FLIGHT),
        (_ops_hover.hover, HOVER),
        (_ops_hover.hover_vjp, HOVER + _ops_hover.HoverSolution._fields),
    ],
)
def test_ops_begin_with_their_inputs(op, fields):
    assert op_arguments(op)[: len(fields)] == fields


def test_the_adjoint_of_a_flight_takes_the_same_inputs():
    arguments = op_arguments(_ops_flight.flight_vjp)
    start = arguments.index("start")
    assert arguments[start : start + len(FLIGHT)] == FLIGHT


@pytest.mark.parametrize("op", [_ops_flight.flight, _ops_flight.flight_vjp])
def test_flights_end_with_their_settings(op):
    assert op_arguments(op)[-len(SETTINGS) :] == SETTINGS
