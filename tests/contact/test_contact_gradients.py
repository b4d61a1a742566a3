"""Is every gradient of a step in contact exact? Central differences, float64, a few elements.

Statuses must not change within the differences of 1e-6: scenes are generic, and each test says
which statuses it has. Tolerances as in tests/soft/test_step_gradients.py.
"""

import copy
import math
import pickle

import pytest
import torch

from diffsim import contact, mesh, soft
from diffsim.contact.handles import shape_of
from diffsim.soft import _ops_contact
from tests.covering import covering
from tests.gradients import check_directions
from tests.helpers import check_layer
from tests.soft.cases import (
    SHARP,
    irregular_mesh,
    leaf,
    noise,
    record_calls,
    recorded_op,
    soft_body,
    two_muscles,
)

pytestmark = pytest.mark.grad
REVERSE = {"eps": 1e-6, "atol": 2e-5, "rtol": 2e-5}
TOLERANCE = {**REVERSE, "check_forward_ad": True}
OBSTACLE = (
    "friction", "restitution", "position", "rotation", "velocity", "angular_velocity", "radius",
)  # fmt: skip
STATUS = {"separate": 0, "stick": 1, "slip": 2}


def inputs_of(m, mode: str) -> dict:
    """A body that meets a big, moving, turning capsule from above, as ``mode`` says.

    The lower face is flat but for noise, at z of about 0 where the capsule has its top.
    """
    speed = {"stick": 0.02, "slip": 3.0, "mixed": 0.4, "separate": 0.1, "bounce": 0.4}[mode]
    friction = {"stick": 30.0, "slip": 0.1, "mixed": 0.25, "separate": 0.5, "bounce": 0.3}[mode]
    v = torch.zeros(m.num_nodes, 3, dtype=torch.float64)
    v[:, 0] = speed
    v[:, 1] = 0.4 * speed
    v[:, 2] = {"separate": 1.0, "bounce": -3.0}.get(mode, -2.0)
    x = m.x_rest.clone()
    x[:, 2] += 0.3 if mode == "separate" else 0.02
    bounce = {"restitution": 0.6} if mode == "bounce" else {}
    return {
        "x": x,
        "v": v + 0.02 * noise(m.num_nodes, 3, seed=2),
        "external_force": 0.1 * noise(m.num_nodes, 3, seed=3),
        "youngs_modulus": 30.0,
        "poissons_ratio": 0.3,
        "density": 1.5,
        "gravity": [0.1, -0.05, -2.0],
        "friction": friction,
        "position": [0.45, 0.55, -3.0],
        "rotation": [0.1, 0.2, -0.1],
        "velocity": [0.02, -0.03, 0.05],
        "angular_velocity": [0.01, 0.02, 0.03] if mode == "stick" else [0.05, -0.04, 0.1],
        "radius": 3.0,
        **bounce,
    }


def obstacle_of(given: dict) -> contact.Obstacle:
    own = {name: given.pop(name) for name in OBSTACLE if name in given}
    values = {"friction": math.inf, "position": (0.45, 0.55, -3.0), **own}
    return contact.capsule((-0.5, 0.1, 0.0), (0.4, 0.0, 0.0), values.pop("radius", 3.0), **values)


def layer_of(body, names, num_steps=1, forces=True):
    """Final x, v and the sum of weighted contact forces of the steps."""

    def layer(*args):
        given = dict(zip(names, args, strict=True))
        obstacle = obstacle_of(given)
        state = soft.State(
            given.pop("x", body.x_rest), given.pop("v", torch.zeros_like(body.x_rest))
        )
        signals = {k: given.pop(k) for k in ("external_force", "activation") if k in given}
        physics = body.physics(**given)
        total = torch.zeros_like(state.x)
        for k in range(num_steps):
            state = soft.step(body, state, physics=physics, obstacles=obstacle, **signals)
            total = total + (1.0 + 0.3 * k) * state.contact_force
            obstacle = obstacle.after(body.dt)
        out = [state.x.flatten(), 0.1 * state.v.flatten()]
        return torch.cat([*out, 0.1 * total.flatten()] if forces else out)

    return layer


def irregular(kind: str):
    return irregular_mesh(kind, (2, 1, 1) if kind == "hex" else (1, 1, 1), (1.0, 1.0, 1.0), 0.04)


@covering(
    mode=["stick", "slip", "mixed", "separate", "bounce"],
    kind=["hex", "tet"],
    integrator=["implicit_euler", "bdf2"],
)
def test_every_input_through_a_rollout(mode, kind, integrator):
    m = irregular(kind)
    body = soft_body(m, dt=0.05, integrator=integrator)
    inputs = {k: leaf(v) for k, v in inputs_of(m, mode).items()}
    layer, args = layer_of(body, inputs, 3), tuple(inputs.values())
    met = [out[2].flatten() for _, out in record_calls("contact_step", lambda: layer(*args))[1]]
    found = torch.cat(met) if met else torch.zeros(0)  # in free flight BDF2 solves without contact
    counts = {name: int((found == value).sum()) for name, value in STATUS.items()}
    if mode == "stick":
        assert counts["stick"] > 3 and counts["slip"] == 0
    elif mode == "slip":
        assert counts["slip"] > 3 and counts["stick"] == 0
    elif mode == "mixed":
        assert counts["slip"] > 0 and counts["stick"] > 0
    elif mode == "separate":
        assert counts["slip"] + counts["stick"] == 0
    out = layer(*args)
    grads = torch.autograd.grad(
        out, args, torch.linspace(1, 2, out.numel(), dtype=out.dtype), allow_unused=True
    )
    # A bounce that sets off from where the node started does not know how thick the capsule is.
    silent = {"separate": {*OBSTACLE}, "stick": {"friction"}, "bounce": {"radius"}}.get(mode, set())
    for name, grad in zip(inputs, grads, strict=True):
        alive = grad is not None and bool(grad.abs().max() > 1e-7)
        assert alive == (name not in silent), f"{name}: gradient {'found' if alive else 'lost'}"
    check_directions(layer, args, **TOLERANCE)


def test_every_entry_of_one_step():
    """The adjoint's full Jacobian, not a projection of it: nodes that stick, slip and leave."""
    m = irregular("tet")
    body = soft_body(m, dt=0.05)
    inputs = {k: leaf(v) for k, v in inputs_of(m, "mixed").items()}
    layer, args = layer_of(body, inputs), tuple(inputs.values())
    assert torch.autograd.gradcheck(layer, args, check_undefined_grad=False, **REVERSE)


METHODS = ["auto", "newton_pcg", "newton_cholesky", "newton_jacobi"]


@pytest.mark.parametrize(
    ("method", "options"),
    [
        *((m, {"cache_columns": keeps}) for m in METHODS for keeps in (True, False)),
        ("newton_pcg", {"preconditioner": "multigrid"}),
    ],
)
def test_every_method(method, options):
    m = irregular("hex")
    options = soft.SolverOptions(method=method, **options, **SHARP)
    body = soft_body(m, dt=0.05, solver=options)
    names = ("x", "v", "youngs_modulus", "friction", "position", "radius")
    inputs = inputs_of(m, "mixed")
    args = tuple(leaf(inputs[name]) for name in names)
    layer = layer_of(body, names, 2)
    check_directions(layer, args, **TOLERANCE)
    usual = layer_of(soft_body(m, dt=0.05), names, 2)
    torch.testing.assert_close(layer(*args), usual(*args), rtol=0, atol=1e-10)


def test_infinite_friction():
    m = irregular("hex")
    body = soft_body(m, dt=0.05)
    inputs = inputs_of(m, "stick")
    names = [n for n in inputs if n != "friction"]
    args = tuple(leaf(inputs[name]) for name in names)
    layer = layer_of(body, names, 2)
    check_directions(layer, args, **TOLERANCE)


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])
def test_damping_muscles_and_dirichlet_nodes(integrator):
    m = irregular_mesh("hex", (2, 1, 1), (1.0, 1.0, 1.0), 0.04)
    held = m.x_rest[:, 2] > 0.5
    fixed = held[:, None] & torch.tensor([True, False, True])  # rails along y
    body = soft_body(m, dt=0.05, fixed=fixed, muscles=two_muscles(), integrator=integrator)
    inputs = inputs_of(m, "slip")
    inputs["v"][held] = 0.0
    inputs |= {
        "activation": [0.8, 0.3],
        "rayleigh_alpha": 0.4,
        "rayleigh_beta": 0.02,
        "fiber_stiffness": [8.0, 6.0],
    }
    inputs["x"] = torch.where(fixed, m.x_rest, inputs["x"])
    args = tuple(leaf(v) for v in inputs.values())
    layer = layer_of(body, inputs, 3)
    state = soft.State(inputs["x"], inputs["v"])
    force = body(state, obstacles=obstacle_of(dict(inputs))).contact_force
    assert 0 < int((force.abs().amax(1) > 0).sum()) <= int((~held).sum())
    check_directions(layer, args, **TOLERANCE)


def test_batch_of_two_and_strided_inputs():
    m = irregular("hex")
    body = soft_body(m, dt=0.05)
    some, other = inputs_of(m, "stick"), inputs_of(m, "slip")
    x = torch.stack([some["x"], other["x"]], -1)  # the batch axis last: not contiguous below
    v = torch.stack([some["v"], other["v"]], -1)
    external = 0.1 * noise(3, m.num_nodes, seed=3)

    def layer(x, v, external, friction, radius):
        given = {"friction": friction, "radius": radius}
        state = soft.State(x.permute(2, 0, 1), v.permute(2, 0, 1))
        end = body(state, obstacles=obstacle_of(given), external_force=external.T)
        return torch.cat([end.x.flatten(), end.v.flatten(), end.contact_force.flatten()])

    args = (leaf(x), leaf(v), leaf(external), leaf(0.3), leaf(3.0))
    check_directions(layer, args, **TOLERANCE)
    whole = layer(*args).detach()
    for k in range(2):
        single = layer(*(a[..., k : k + 1] if i < 2 else a for i, a in enumerate(args)))
        assert torch.equal(single, whole.reshape(3, 2, -1)[:, k].reshape(-1))


def test_contract_of_the_op():
    """opcheck, differences and torch.compile of the layer under the step."""
    m = irregular("tet")
    body = soft_body(m, dt=0.05)
    inputs = {k: leaf(v) for k, v in inputs_of(m, "mixed").items()}
    step = layer_of(body, inputs)
    ops = recorded_op("contact_step", lambda: step(*inputs.values()))
    given = dict(zip(_ops_contact.contact_step.arguments, ops[0][1], strict=True))
    given = {n: v.detach() if torch.is_tensor(v) else v for n, v in given.items()}
    names = "y", "force", "normal", "reference", "offset", "friction"

    def layer(y, force, normal, reference, offset, friction):
        unit = normal / normal.norm(dim=-1, keepdim=True)  # the kernel takes unit normals
        moved = zip(names, (y, force, unit, reference, offset, friction), strict=True)
        x, contact_force, *_ = _ops_contact.contact_step(**given | dict(moved))
        return torch.cat([x.flatten(), contact_force.flatten()])

    args = tuple(leaf(given[name]) for name in names)
    check_layer(layer, args, ops=ops, fast_mode=True, **TOLERANCE)


def test_checkpointed_rollout_has_the_same_gradient():
    m = irregular("hex")
    body = soft_body(m, dt=0.05)
    inputs = inputs_of(m, "mixed")
    grads = []
    for every in (None, 2):
        x, v, mu = leaf(inputs["x"]), leaf(inputs["v"]), leaf(0.25)
        ball = obstacle_of({**inputs, "friction": mu})
        end = soft.rollout(body, soft.State(x, v), 5, obstacles=ball, checkpoint_every=every).final
        loss = (end.x * noise(*x.shape, seed=8)).sum() + end.contact_force.square().sum()
        grads.append(torch.autograd.grad(loss, (x, v, mu)))
    for plain, again in zip(*grads, strict=True):
        assert torch.equal(plain, again)


def assert_one_graph(obstacles, friction, speed: float, backend: str) -> None:
    """A step of a landing body with fullgraph=True: the bits of the step, and its gradients."""
    torch.compiler.reset()  # or too many graphs of one function
    m = irregular_mesh("tet", (1, 1, 1))
    body = soft_body(m)
    x = m.x_rest - torch.tensor([0.0, 0.0, 1.0]) * (m.x_rest[:, 2].min() - 0.02)
    v = leaf(torch.tensor([-0.8, 0.3, -speed]).double() + 0.02 * noise(m.num_nodes, 3, seed=2))

    def layer(v):
        end = soft.step(body, soft.State(x, v), obstacles=obstacles)
        return torch.cat([end.x, end.v, end.contact_force])

    whole = torch.compile(layer, fullgraph=True, backend=backend)
    results = []
    for function in (layer, whole):
        out = function(v)
        results.append((out, *torch.autograd.grad(out, (v, friction), noise(*out.shape))))
    assert int((results[0][0][-m.num_nodes :] != 0.0).any(1).sum()) > 1
    assert torch.equal(results[0][0], results[1][0])
    for one, other in zip(*results, strict=True):  # sums of gradients run in another order
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


@pytest.mark.story  # compiles, the adjoint too
def test_steps_on_half_spaces_are_one_graph():
    """One that moves and one that rests, friction and restitution."""
    motion = {"velocity": (0.1, 0.0, 0.2), "angular_velocity": (0.0, 0.1, 0.0)}
    friction = leaf(0.2)
    floor = contact.floor(friction=friction, restitution=0.3, **motion)
    ramp = contact.plane((1.0, 0.2, 0.3), -0.1, friction=0.4)
    assert_one_graph([floor, ramp], friction, 2.0, "aot_eager")


def terrain() -> contact.HeightField:
    heights = 0.1 * torch.rand(12, 12, generator=torch.Generator().manual_seed(0)).double()
    return contact.HeightField(heights, 0.5, (-2.0, -2.0, -0.15))


def plate():
    m = mesh.tet_box((1, 1, 1), (6.0, 6.0, 0.2), origin=(-3.0, -3.0, -0.1))
    return mesh.to_trimesh(m)


SHAPES = {  # each with its place below a body whose lower face is at z = 0
    "ball": (lambda: contact.Sphere(3.0), (1.0, 0.5, -3.0)),
    "container": (lambda: contact.Sphere(3.0, inside_out=True), (1.0, 0.5, 2.7)),
    "trough": (lambda: contact.Trough(3.0, 3.0, start=(1.0, 0.0, 0.0)), (1.0, 0.0, 2.7)),
    "sheet that a step would jump": (lambda: contact.Box((6.0, 6.0, 0.004)), (1.0, 0.5, -0.1)),
    "terrain": (terrain, (0.0, 0.0, 0.0)),
    "surface": (lambda: contact.MeshShape(plate()), (1.0, 0.5, -0.1)),
}


def assert_one_graph_on(name: str, beside_a_floor: bool, backend: str) -> None:
    made, place = SHAPES[name]
    friction = leaf(0.2)
    obstacles = [contact.Obstacle(made(), position=place, friction=friction)]
    floor = [contact.floor(-4.0)] if beside_a_floor else []
    assert_one_graph([*floor, *obstacles], friction, 8.0, backend)


QUICK = ("ball", "sheet that a step would jump")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.story] * (n not in QUICK)) for n in SHAPES]
)
def test_steps_on_every_shape_are_one_graph(name):
    """Every other one beside a floor, whose half space is written into the same graph.

    "aot_eager", which traces the adjoint too, takes four times as long: for one of them.
    """
    backend = "aot_eager" if name == "container" else "eager"
    assert_one_graph_on(name, list(SHAPES).index(name) % 2 == 1, backend)


def landing_velocity():
    nodes = irregular_mesh("tet", (1, 1, 1)).num_nodes
    return leaf(torch.tensor([-0.8, 0.3, -8.0]).double() + 0.02 * noise(nodes, 3, seed=2))


def landing_on_waves():
    """Positions after a step, a function of velocities, and the ground, which is a function."""
    m = irregular_mesh("tet", (1, 1, 1))
    body = soft_body(m)
    ground = contact.Obstacle(contact.Custom(lambda x: x[:, 2] + 0.3 * torch.sin(x[:, 0])))
    x = m.x_rest - torch.tensor([0.0, 0.0, 1.0]) * (m.x_rest[:, 2].min() - 0.02)
    return lambda v: soft.step(body, soft.State(x, v), obstacles=ground).x, ground


@pytest.mark.story  # compiles
def test_a_distance_function_breaks_the_graph_and_stays_right():
    end, _ = landing_on_waves()
    with pytest.raises(torch._dynamo.exc.Unsupported):
        torch.compile(end, fullgraph=True, backend="aot_eager")(landing_velocity())
    torch.compiler.reset()
    assert_same_compiled(end, landing_velocity())


def assert_same_compiled(function, x) -> None:
    """The function and its gradient, compiled in as many graphs as it takes."""
    compiled = torch.compile(function, backend="eager")
    plain, other = (torch.autograd.grad(f(x).square().sum(), x)[0] for f in (function, compiled))
    torch.testing.assert_close(plain, other, rtol=1e-12, atol=1e-12)
    assert bool((plain != 0.0).any())


def landing_by_bdf2(steps: int):
    """A function of velocities: bodies that fly, then land."""
    m = irregular_mesh("tet", (1, 1, 1))
    body = soft_body(m, integrator="bdf2")
    x = m.x_rest - torch.tensor([0.0, 0.0, 1.0]) * (m.x_rest[:, 2].min() - 0.6)
    v = leaf(torch.tensor([-0.8, 0.3, -4.0]).double() + 0.02 * noise(m.num_nodes, 3, seed=2))

    floor = contact.floor(friction=0.3)

    def layer(v):
        end = soft.State(x, v)
        for _ in range(steps):
            end = soft.step(body, end, obstacles=floor)
        return torch.cat([end.x, end.contact_force])

    return layer, v, m.num_nodes


def test_bdf2_among_obstacles_says_why_it_is_not_one_graph():
    layer, v, _ = landing_by_bdf2(1)
    with pytest.raises(torch._dynamo.exc.Unsupported, match="integrator='implicit_euler'"):
        torch.compile(layer, fullgraph=True, backend="aot_eager")(v)


@pytest.mark.story
def test_bdf2_among_obstacles_breaks_the_graph_and_stays_right():
    layer, v, num_nodes = landing_by_bdf2(2)
    assert not bool((landing_by_bdf2(1)[0](v)[num_nodes:] != 0.0).any())
    assert bool((layer(v)[num_nodes:] != 0.0).any())
    assert_same_compiled(layer, v)


def test_a_copied_shape_is_another_one():
    ball = contact.Sphere(1.0)
    for other in (copy.deepcopy(ball), pickle.loads(pickle.dumps(ball))):
        assert other.handle != ball.handle
        assert shape_of(other.handle, contact.Sphere) is other
    with pytest.raises(RuntimeError, match="keep obstacles alive"):
        shape_of(ball.handle, contact.Box)
