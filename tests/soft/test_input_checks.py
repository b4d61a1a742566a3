"""Every public function refuses what it cannot use and says what came, what is needed, what to
do. NaN, infinity, other types and shapes of every argument: tests/test_arguments.py."""

import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from diffsim import mesh, soft
from diffsim.core.errors import DiffsimError
from diffsim.soft import _ops_elastic
from diffsim.soft._arrays import EnergyArrays
from tests.helpers import at_rest
from tests.soft.cases import irregular_mesh, soft_body, two_muscles

MESH = mesh.hex_box((2, 1, 1))
NODES, ELEMENTS = MESH.num_nodes, MESH.num_elements
BODY = soft_body(MESH, fixed=torch.tensor([0, 1, 2, 3]))
MUSCULAR = soft_body(MESH, fixed=torch.tensor([0, 1, 2, 3]), muscles=two_muscles())
NAN, INF = float("nan"), float("inf")


class Thing:
    """No argument of anything."""


def zeros(*shape, **options):
    return torch.zeros(*shape, **{"dtype": torch.float64, **options})


def make(**changes):
    return soft_body(MESH, **changes)


STATE = BODY.rest_state()

# (arguments of SoftBody, exception, message)
BAD_BODIES = [
    (
        {"integrator": "implicit_eular"},
        ValueError,
        "got 'implicit_eular'; did you mean 'implicit_euler'",
    ),
    ({"volume_weight": "small-strain"}, ValueError, "did you mean 'small_strain'"),
    ({"poissons_ratio": [0.3, 0.6]}, ValueError, "poissons_ratio must lie in.*got 0.6"),
    ({"attached_mass": -torch.ones(NODES).double()}, ValueError, "attached_mass must lie in.*kg"),
    ({"node_mass": zeros(NODES)}, ValueError, "node_mass must lie in.*got 0"),
    ({"fixed": [0.0, 1.5]}, TypeError, "fixed must be an array of numbers.*not whole numbers"),
    (
        {"fixed": torch.tensor([0, NODES])},
        ValueError,
        rf"fixed must hold indices of nodes in \[0, {NODES}\), got {NODES}",
    ),
    ({"fixed": torch.tensor([-1])}, ValueError, "fixed must hold indices.*got -1"),
    (
        {"fixed": torch.tensor([0], dtype=torch.int32)},
        TypeError,
        "fixed must be torch.int64, got torch.int32",
    ),
    ({"fixed": torch.tensor([0.0])}, TypeError, "fixed must be torch.int64, got torch.float32"),
    ({"fixed": torch.zeros(NODES + 1, dtype=torch.bool)}, ValueError, "fixed must have shape"),
    ({"fixed": torch.zeros(NODES, 2, dtype=torch.bool)}, ValueError, "fixed must have shape"),
    ({"muscles": ["biceps"]}, TypeError, r"muscles\[0\] must be a Muscle, got str"),
    (
        {"muscles": [soft.Muscle(elements=torch.tensor([9]), direction=[1, 0, 0], stiffness=1.0)]},
        ValueError,
        rf"muscles\[0\].elements must hold indices of elements in \[0, {ELEMENTS}\), got 9",
    ),
]


@pytest.mark.parametrize("arguments, error, message", BAD_BODIES, ids=lambda v: str(v)[:40])
def test_bodies_are_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        make(**arguments)


X, V = STATE.x, STATE.v
BAD_STATES = [
    (
        soft.State(X[:-1], V),
        ValueError,
        rf"state.x must have shape \(..., {NODES}, 3\), got \({NODES - 1}, 3\)",
    ),
    (soft.State(X.flatten(), V), ValueError, "state.x must have shape"),
    (soft.State(X[:, :2], V), ValueError, "state.x must have shape"),
    (soft.State(X.T, V), ValueError, "state.x must have shape"),
    (soft.State(X, V[:-1]), ValueError, "state.v must have shape"),
    (soft.State(X.expand(2, -1, -1), V), ValueError, "state.v must have shape"),
    (soft.State(X, V, X[:-1], V), ValueError, "state.x_prev must have shape"),
    (soft.State(X, V, X, V * NAN), ValueError, "state.v_prev must be finite"),
]


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2", "semi_implicit_euler"])
@pytest.mark.parametrize(
    "state, error, message", BAD_STATES, ids=lambda v: str(v)[:40] if isinstance(v, str) else ""
)
def test_states_are_refused(state, error, message, integrator):
    body = make(integrator=integrator)
    with pytest.raises(error, match=message):
        body(state)
    with pytest.raises(error, match=message):
        soft.rollout(body, state, 2)


BAD_INPUTS = [
    (
        {"external_force": zeros(NODES, 2)},
        ValueError,
        rf"external_force must have shape \(..., {NODES}, 3\), got",
    ),
    (
        {"external_force": zeros(2, NODES, 3)},
        ValueError,
        "external_force must broadcast to.*batch axes",
    ),
    ({"dirichlet_target": zeros(4, 3)}, ValueError, "dirichlet_target must have shape"),
    ({"dirichlet_target": zeros(3, NODES, 3)}, ValueError, "dirichlet_target must broadcast to"),
    ({"activation": zeros(3)}, ValueError, r"activation must have shape \(..., 2\), got \(3,\)"),
    ({"activation": zeros(())}, ValueError, "activation must have shape"),
    ({"activation": zeros(4, 2)}, ValueError, "activation must broadcast to"),
    (
        {"physics": {"density": 1.0}},
        TypeError,
        "physics must (be a Physics|come from body.physics.*), got dict",
    ),
    (
        {"physics": soft_body(mesh.hex_box((3, 1, 1))).physics()},
        ValueError,
        "physics must be made by this body.*for 16 vertices and 3 elements, the body has 12 and 2",
    ),
]


MOVED = MUSCULAR.physics(x_rest=1.01 * MESH.x_rest, rayleigh_beta=1e-3)
TENSORS = [f.name for f in dataclasses.fields(MOVED) if torch.is_tensor(getattr(MOVED, f.name))]


@pytest.mark.parametrize("name", TENSORS)
def test_fields_of_physics_made_by_hand_are_refused(name):
    right = getattr(MOVED, name)
    wrong = [right * NAN, right * INF, right.float(), right.to("meta"), "text", 1.0, Thing()]
    wrong += [right.expand(2, 3, *right.shape)]
    wrong += [torch.cat([right, right]), right[:-1]] if right.ndim else []
    wrong += [] if name in ("rayleigh_beta", "x_rest", "tables") else [None]
    for value in wrong:
        physics = dataclasses.replace(MOVED, **{name: value})
        with pytest.raises((TypeError, ValueError), match=rf"physics must|\b{name} must"):
            MUSCULAR(STATE, physics=physics)


@pytest.mark.parametrize(
    "name",
    ["mass", "weighing_mass", "fiber_stiffness", "rayleigh_alpha", "rayleigh_beta", "weights"],
)
def test_negative_numbers_in_physics_made_by_hand_are_refused(name):
    physics = dataclasses.replace(MOVED, **{name: -1.0 - getattr(MOVED, name)})
    with pytest.raises(ValueError, match=f"physics.{name} must lie in"):
        MUSCULAR.rest_state(physics=physics)


def test_a_negative_bulk_modulus_made_by_hand_is_refused():
    weights = MOVED.weights.clone()
    weights[1] = -2.0 * weights[0]
    with pytest.raises(ValueError, match=r"physics.weights must lie in .* bulk modulus is < 0"):
        MUSCULAR.rest_state(physics=dataclasses.replace(MOVED, weights=weights))


@pytest.mark.parametrize("inputs, error, message", BAD_INPUTS, ids=lambda v: str(v)[:40])
def test_step_inputs_are_refused(inputs, error, message):
    with pytest.raises(error, match=message):
        MUSCULAR(STATE, **inputs)
    with pytest.raises(error, match=message):
        soft.rollout(MUSCULAR, STATE, 2, **inputs)
    statics = {k: v for k, v in inputs.items() if "broadcast" not in message}
    if statics:  # in statics the inputs' leading axes make the batch
        with pytest.raises(error, match=message):
            MUSCULAR.static_equilibrium(**statics)
    elastic = {k: v for k, v in inputs.items() if k in ("activation", "physics")}
    if elastic:
        for function in (MUSCULAR.elastic_force, MUSCULAR.elastic_energy):
            with pytest.raises(error, match=message):
                function(X, **elastic)


def test_inconsistent_batches_are_refused():
    state = BODY.rest_state(2)
    with pytest.raises(ValueError, match=r"external_force must broadcast to \(2, .*got \(3, "):
        BODY(state, external_force=zeros(3, NODES, 3))
    with pytest.raises(ValueError, match="activation must broadcast to"):
        MUSCULAR(state, activation=zeros(3, 2) + 1.0)
    with pytest.raises(ValueError, match="dirichlet_target must broadcast to"):
        MUSCULAR.static_equilibrium(
            external_force=zeros(2, NODES, 3), dirichlet_target=zeros(3, NODES, 3)
        )
    with pytest.raises(ValueError, match=r"batch axis \(3,\) .*, got \(2,\); begin .*batch=3"):
        BODY(state, physics=BODY.physics(batch=3))
    with pytest.raises(
        ValueError, match="contraction muscles must be the same for the whole batch"
    ):
        MUSCULAR(state, activation=torch.tensor([[1.0, 0.5], [1.0, 0.6]], dtype=torch.float64))


def test_activation_without_muscles_is_refused():
    for call in (
        lambda: BODY(STATE, activation=zeros(1)),
        lambda: BODY.elastic_force(X, activation=zeros(1)),
        lambda: BODY.static_equilibrium(activation=zeros(1)),
    ):
        with pytest.raises(ValueError, match="activation was given, but the body has no muscles"):
            call()


@pytest.mark.parametrize(
    "arguments, error, message",
    [
        ({"num_steps": 2, "checkpoint_every": 0}, ValueError, "checkpoint_every must lie in"),
        (
            {"num_steps": 2, "checkpoint_every": 1.5},
            TypeError,
            "checkpoint_every must be a whole number, got float",
        ),
        (
            {"num_steps": 2, "external_force": lambda k, s: zeros(2, 2)},
            ValueError,
            "external_force must have shape",
        ),
        ({"num_steps": 2, "keep": 3}, TypeError, "keep must be a Callable, got int"),
    ],
)
def test_rollouts_are_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        soft.rollout(BODY, STATE, **arguments)


def test_options_and_muscles_are_frozen():
    with pytest.raises(AttributeError):
        soft.SolverOptions().rtol = 1e-3
    with pytest.raises(AttributeError):
        two_muscles()[0].stiffness = 3.0


def test_an_unstable_explicit_step_is_refused():
    body = make(integrator="semi_implicit_euler", dt=10.0, youngs_modulus=1e9)
    state = soft.State(X * 1.1, V)
    with pytest.raises(DiffsimError, match="explicit step became unstable at dt = 10 s; reduce dt"):
        soft.rollout(body, state, 100)


def test_mutating_the_inputs_of_a_mesh_changes_nothing():
    x = MESH.x_rest.clone()
    m = mesh.HexMesh(x, MESH.hexes)
    x.zero_()
    assert torch.equal(m.x_rest, MESH.x_rest)


@settings(max_examples=40, deadline=None)
@given(shape=st.lists(st.integers(0, 4), max_size=4))
def test_any_shape_of_force_is_used_or_refused(shape):
    """Shapes end in (num_nodes, 3) and broadcast to the state, or raise ValueError."""
    try:
        end = BODY(STATE, external_force=zeros(tuple(shape)))
    except ValueError as error:
        assert "external_force must" in str(error)
    else:
        assert tuple(shape[-2:]) == (NODES, 3)
        assert end.x.shape == X.shape


@settings(max_examples=25, deadline=None)
@given(
    cells=st.tuples(*[st.integers(1, 3)] * 3),
    kind=st.sampled_from(["hex", "tet"]),
    batch=st.integers(1, 3),
    method=st.sampled_from(["auto", "quasi_newton", "newton_cholesky"]),
)
def test_any_box_steps(cells, kind, batch, method):
    """Sizes around the eight SIMD lanes: no lane of padding reaches a result."""
    m = irregular_mesh(kind, cells, cells, 0.05)
    body = soft_body(
        m, fixed=torch.tensor([0]), solver=soft.SolverOptions(method=method, rtol=1e-9)
    )
    end = body(body.rest_state(batch))
    assert end.x.shape == (batch, m.num_nodes, 3)
    assert end.x.isfinite().all()
    mass = body.physics().mass
    assert float(mass.sum()) == pytest.approx(1.5 * float(body.nodal_volume.sum()))
    one = body(body.rest_state())
    torch.testing.assert_close(end.x, one.x.expand_as(end.x), rtol=0, atol=0)


def test_empty_batches_are_used_or_refused():
    state = soft.State(zeros(0, NODES, 3), zeros(0, NODES, 3))
    try:
        end = BODY(state)
    except ValueError as error:
        assert "batch" in str(error)
    else:
        assert end.x.shape == (0, NODES, 3)


def test_ops_refuse_sizes_that_kernels_would_overrun():
    """The ops are the door to compiled code: public functions check, but so do they."""
    physics, empty = BODY.physics(), zeros(0)
    x, none = X[None].contiguous(), zeros(1, 0)
    good = {
        **dict.fromkeys(EnergyArrays.specs, empty),
        "weights": physics.weights,
        "activation": none,
        "pressure": none,
    }

    def call(x, handle=BODY.handle, **changes):
        tensors = EnergyArrays(**{**good, **changes}).tensors()
        return _ops_elastic.elastic_gradient(x, *tensors, handle=handle, num_threads=1)

    call(x)
    with pytest.raises(ValueError, match="must have shape"):
        call(x[:, 1:].contiguous())
    for name, bad in [
        ("weights", physics.weights[1:]),
        ("weights", zeros(2, ELEMENTS + 1)),
        ("fiber_stiffness", zeros(1)),
        ("activation", zeros(1, 3)),
        ("damp_mu", zeros(1)),
        ("x_frame", x),
        ("pressure", zeros(1, 1)),
    ]:
        with pytest.raises(ValueError, match=rf"{name} must have shape"):
            call(x, **{name: bad})
    with pytest.raises(RuntimeError, match="handle 0 is gone"):
        call(x, handle=0)


def test_arrays_of_kernels_are_named():
    """Two tensors of one shape cannot change places: a record takes keywords only."""
    one = zeros(ELEMENTS)
    with pytest.raises(TypeError, match="positional"):
        EnergyArrays(one, one)
    with pytest.raises(TypeError, match="missing 8 required keyword-only"):
        EnergyArrays(fiber_stiffness=one)


def test_a_gradient_by_the_rest_shape_is_refused():
    """It was -0.030 where differences give 0.955."""
    m = irregular_mesh("hex", (1, 1, 1))
    body = soft_body(m)
    body.x_rest = body.x_rest.clone().requires_grad_()
    with pytest.raises(ValueError, match="x_rest must not require grad"):
        body(at_rest(body.x_rest.detach()))
    m.x_rest.requires_grad_()
    with pytest.raises(ValueError, match=r"mesh\.x_rest must not require grad"):
        soft_body(m)


def test_a_rest_shape_in_place_of_the_mesh_s_is_refused():
    m = irregular_mesh("hex", (1, 1, 1))
    body = soft_body(m)
    other = {"x_rest": 1.1 * m.x_rest}
    with pytest.raises(ValueError, match="must be its mesh's"):
        torch.func.functional_call(body, other, (at_rest(m.x_rest),))
    same = torch.func.functional_call(body, {"x_rest": m.x_rest.clone()}, (at_rest(m.x_rest),))
    assert torch.equal(same.x, body(at_rest(m.x_rest)).x)
    body.x_rest = body.x_rest.float()
    with pytest.raises(ValueError, match="must be its mesh's, float64"):
        body(at_rest(m.x_rest))
