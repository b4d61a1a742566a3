"""Fields of the named tuples are the arguments of the ops, in their order."""

from diffsim.stokes import _ops_flow
from tests.helpers import op_arguments

FIELDS = _ops_flow.FlowInputs._fields


def test_the_op_begins_with_its_inputs():
    assert op_arguments(_ops_flow.stokes_flow)[: len(FIELDS)] == FIELDS


def test_the_adjoint_takes_the_same_inputs():
    arguments = op_arguments(_ops_flow.stokes_flow_vjp)
    start = arguments.index("phi")
    assert arguments[start : start + len(FIELDS)] == FIELDS


def test_the_tangent_takes_the_same_inputs_and_their_directions():
    arguments = op_arguments(_ops_flow.stokes_flow_jvp)
    start, count = arguments.index("phi"), len(FIELDS)
    assert arguments[start : start + count] == FIELDS
    assert arguments[start + count : start + 2 * count] == tuple(f"d_{name}" for name in FIELDS)
