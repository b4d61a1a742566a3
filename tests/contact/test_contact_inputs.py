"""Mistakes at the boundary: every message says what was wrong and what to do."""

import pytest
import torch

from diffsim import contact, soft
from diffsim.core.errors import ConvergenceError
from diffsim.soft import _ops_contact
from tests.contact.scenes import moving, slab
from tests.soft.cases import record_calls

FLOOR = contact.floor()


def step_with(obstacles=FLOOR, state=None, **changes):
    body = slab(**changes)
    return body(body.rest_state() if state is None else state(body), obstacles=obstacles)


def bad_force(shape):
    return lambda body: body.rest_state()._replace(
        contact_force=torch.zeros(shape, dtype=torch.float64)
    )


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"obstacles": []}, ValueError, "at least one Obstacle"),
        ({"obstacles": [contact.Sphere(1.0)]}, TypeError, r"obstacles\[0\] must be an Obstacle"),
        ({"obstacles": contact.Sphere(1.0)}, TypeError, "must be an Obstacle or a sequence"),
        ({"obstacles": 3}, TypeError, "must be an Obstacle or a sequence"),
        ({"integrator": "implicit_midpoint"}, ValueError, "obstacles need one of the integrators"),
        ({"integrator": "semi_implicit_euler"}, ValueError, "or use contact.penalty_force"),
        (
            {"solver": soft.SolverOptions(method="quasi_newton")},
            ValueError,
            "'quasi_newton' does not handle obstacles; use 'auto'",
        ),
        ({"contact_nodes": torch.tensor([0.0])}, TypeError, "contact_nodes must be torch.int64"),
        ({"contact_nodes": [0.5]}, TypeError, "contact_nodes must be an array of numbers"),
        ({"contact_nodes": torch.tensor([[0]])}, ValueError, "contact_nodes must have shape"),
        ({"contact_nodes": torch.tensor([999])}, ValueError, r"indices of nodes in \[0, 18\)"),
        ({"contact_nodes": torch.tensor([-1])}, ValueError, "contact_nodes must hold indices"),
        ({"contact_nodes": torch.tensor([3, 3])}, ValueError, "must not name a node twice"),
        (
            {"contact_nodes": torch.tensor([0, 1]), "fixed": torch.tensor([1])},
            ValueError,
            "no Dirichlet condition, got 1 fixed ones, first node 1; leave them out",
        ),
        ({"state": bad_force((5, 3))}, ValueError, "state.contact_force must have shape"),
        ({"state": bad_force((2, 18, 3))}, ValueError, "state.contact_force must have shape"),
    ],
)
def test_steps_refuse(arguments, error, message):
    with pytest.raises(error, match=message):
        step_with(**arguments)


@pytest.mark.parametrize("value", [1, None, "yes"])
def test_cache_columns_is_a_bool(value):
    with pytest.raises(TypeError, match="cache_columns must be True or False, got"):
        soft.SolverOptions(cache_columns=value)


def test_an_obstacle_that_starts_inside_the_body():
    body = slab("hex", (4, 4, 4), (1.0, 1.0, 1.0))
    inside = contact.sphere(0.2, position=(0.0, 0.0, 0.5), name="pebble")
    with pytest.raises(ValueError, match="obstacle 'pebble' starts inside the body: "):
        soft.rollout(body, body.rest_state(), 1, obstacles=inside)
    with pytest.raises(ValueError, match="'pebble' starts inside"):
        soft.rollout(body, body.rest_state(2), 1, obstacles=lambda k, state: [inside])


def test_a_rollout_refuses_what_a_step_refuses():
    body = slab()
    with pytest.raises(TypeError, match="must be an Obstacle"):
        soft.rollout(body, body.rest_state(), 1, obstacles=lambda k, state: [None])
    with pytest.raises(ValueError, match="at least one Obstacle"):
        soft.rollout(body, body.rest_state(), 1, obstacles=[])


def test_no_contact_nodes_at_all():
    """Legal: everything is fixed, or the user said so."""
    none = torch.zeros(0, dtype=torch.int64)
    body = slab(contact_nodes=none)
    free = slab(contact_nodes=none)
    start = moving(body, (0.0, 0.0, -1.0))
    end = body(start, obstacles=FLOOR)
    torch.testing.assert_close(end.x, free(start).x, rtol=0, atol=1e-10)
    assert not end.contact_force.any()


def test_what_did_not_converge_says_so():
    body = slab(solver=soft.SolverOptions(rtol=1e-12, max_iters=1))
    start = moving(body, (2.0, 0.0, -3.0), wobble=1.0)
    with pytest.raises(ConvergenceError, match="implicit step in contact stopped after 1 iterat"):
        body(start, obstacles=contact.floor(friction=0.3))


def call(**changes):
    """The op with correct arguments but for ``changes`` (by name)."""
    body = slab("hex", (1, 1, 1), (1.0, 1.0, 1.0))
    step = record_calls("contact_step", lambda: body(body.rest_state(), obstacles=FLOOR))
    given = step[1][0][0]
    return _ops_contact.contact_step(**given | {n: c(given[n]) for n, c in changes.items()})


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"normal": lambda t: t[:, :4]}, ValueError, r"normal must have shape \(1, 8, 3\)"),
        ({"reference": lambda t: t[..., :2]}, ValueError, "reference must have shape"),
        ({"offset": lambda t: t[..., None]}, ValueError, r"offset must have shape \(1, 8\)"),
        ({"friction": lambda t: t.float()}, TypeError, "friction must be a torch.float64"),
        ({"nodes": lambda n: n.int()}, TypeError, "nodes must be a torch.int64"),
        ({"nodes": lambda n: n + 1}, ValueError, r"contact nodes must lie in \[0, 8\)"),
        ({"nodes": lambda n: n[:5]}, ValueError, r"normal must have shape \(1, 5, 3\)"),
    ],
)
def test_the_op_checks_sizes_before_the_kernel_reads(changes, error, message):
    with pytest.raises(error, match=message):
        call(**changes)
