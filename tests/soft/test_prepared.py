"""Rollouts are prepared once: with and without gradient, and step by step, they are the same."""

import gc
import pickle
import sys
import weakref

import pytest
import torch

from diffsim import contact, soft
from diffsim.soft import _ops_contact, _ops_elastic, _ops_step
from diffsim.soft.forces import ElasticGradient, elastic_gradient
from diffsim.soft.inputs import check_loads
from diffsim.soft.integrators import IMPLICIT
from diffsim.soft.prepared import PreparedBody, prepare
from tests.soft.cases import irregular_mesh, leaf, noise, soft_body, two_muscles
from tests.soft.test_chambers import hollow

STEPS = 5
HELD = torch.tensor([0, 1, 2])


def forced(**changes):
    """A damped body under its own weight and a force that follows it."""
    m = irregular_mesh("hex")
    given = {"rayleigh_alpha": 0.2, "rayleigh_beta": 0.05, "fixed": HELD, "dt": 0.02}
    body = soft_body(m, **{**given, **changes})
    push = 0.5 * noise(m.num_nodes, 3, seed=4)
    return body, {"external_force": lambda k, s: (1 + k) * push - 0.1 * s.v}


def activated(kinds=slice(None)):
    m = irregular_mesh("hex")
    body = soft_body(m, fixed=HELD, muscles=two_muscles()[kinds], rayleigh_beta=0.05)
    still = torch.linspace(1.0, 0.8, body.muscles.num_muscles, dtype=torch.float64)
    return body, {"activation": lambda k, s: still - 0.02 * k}


def inflated():
    m, chamber = hollow()
    body = soft_body(m, chambers=[chamber], fixed=HELD)
    pressure = torch.tensor([0.4], dtype=torch.float64)
    return body, {"pressure": pressure, "external_force": lambda k, s: -0.1 * s.v}


def moved():
    body, given = forced()
    target = body.x_rest + 0.01
    return body, given | {"dirichlet_target": lambda k, s: target + 0.01 * k}


def dropped(integrator):
    m = irregular_mesh("tet", (1, 1, 1))
    body = soft_body(m, integrator=integrator)
    lowest = float(m.x_rest[:, 2].min())
    ground = contact.plane((0.0, 0.0, 1.0), offset=lowest - 0.05, friction=0.2)
    return body, {"obstacles": ground}


def many():
    body, given = forced(gravity=(0.0, 0.0, -1.0))
    values = torch.tensor([20.0, 30.0, 40.0], dtype=torch.float64)
    physics = body.physics(batch=3, youngs_modulus=values)
    return body, given | {"physics": physics, "state": body.rest_state(batch=3)}


LINEAR = soft.SolverOptions(method="linearly_implicit")
CASES = {
    **{name: (lambda name=name: forced(integrator=name)) for name in IMPLICIT},
    "explicit": lambda: forced(integrator="semi_implicit_euler", dt=1e-3),
    "linear": lambda: forced(solver=LINEAR),
    "undamped": lambda: forced(rayleigh_alpha=0.0, rayleigh_beta=0.0),
    "muscles": activated,
    "length_muscle": lambda: activated(slice(1)),
    "chamber": inflated,
    "target": moved,
    "obstacle": lambda: dropped("implicit_euler"),
    "obstacle_bdf2": lambda: dropped("bdf2"),
    "batch": many,
}


def start_of(body, given):
    given = dict(given)
    state = given.pop("state", None) or body.rest_state()
    push = 0.1 * noise(*state.x.shape[-2:], seed=6)
    return soft.State(state.x, torch.where(body.fixed, 0.0, push).expand_as(state.x)), given


def alone(monkeypatch, body, start, given):
    """A rollout in which the step's ops are not called, as where nobody imported the compiler."""

    def refuse(*args, **named):
        raise AssertionError("the op was called")

    with monkeypatch.context() as patch, torch.no_grad():
        patch.delitem(sys.modules, "torch._dynamo", raising=False)
        patch.setattr(_ops_step, "soft_step", refuse)
        patch.setattr(_ops_contact.contact_step.op, "_opoverload", refuse)
        return soft.rollout(body, start, STEPS, **given)


@pytest.mark.parametrize("case", CASES)
def test_with_and_without_gradient_bits_are_the_same(case, monkeypatch):
    body, given = CASES[case]()
    start, given = start_of(body, given)
    plain = alone(monkeypatch, body, start, given)
    x = leaf(start.x)
    graph = soft.rollout(body, start._replace(x=x), STEPS, **given)
    assert graph.x.requires_grad
    assert float((plain.x[-1] - plain.x[0]).abs().max()) > 1e-3
    assert torch.equal(plain.x, graph.x)
    assert torch.equal(plain.v, graph.v)


@pytest.mark.parametrize("case", CASES)
def test_a_rollout_is_a_loop_of_steps(case):
    body, given = CASES[case]()
    start, given = start_of(body, given)
    with torch.no_grad():
        whole = soft.rollout(body, start, STEPS, **given)
        physics, ground = given.pop("physics", None), given.pop("obstacles", None)
        now = start
        for k in range(STEPS):
            loads = {n: s(k, now) if callable(s) else s for n, s in given.items()}
            now = soft.step(body, now, physics=physics, obstacles=ground, **loads)
    assert torch.equal(whole.x[-1], now.x)
    assert torch.equal(whole.v[-1], now.v)


BAD = {
    "external_force": (torch.full((12, 3), torch.nan, dtype=torch.float64), "must be finite"),
    "activation": (torch.ones(3, dtype=torch.float64), "activation must have shape"),
    "dirichlet_target": (torch.ones(12, 3), "dirichlet_target must be torch.float64"),
    "pressure": (torch.ones(1, dtype=torch.float64), "the body has no chambers"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_a_signal_gives_is_checked_in_every_step(name, monkeypatch):
    body, _ = activated()
    bad, message = BAD[name]
    seen = []

    def signal(k, state):
        seen.append(k)
        return bad if k == 2 else None

    with pytest.raises((ValueError, TypeError), match=message):
        alone(monkeypatch, body, body.rest_state(), {name: signal})
    assert seen == [0, 1, 2]


def test_a_bad_state_is_refused_once_at_the_start():
    body, _ = forced()
    start = body.rest_state()
    start.v[3, 1] = torch.inf
    with torch.no_grad(), pytest.raises(ValueError, match=r"state\.v must be finite"):
        soft.rollout(body, start, STEPS)


def test_shared_parameters_are_bound_once(monkeypatch):
    body, given = forced()
    start, given = start_of(body, given)
    made = []
    bound = _ops_step.BoundStep.__init__

    def counted(self, *args, **named):
        made.append(1)
        bound(self, *args, **named)

    monkeypatch.setattr(_ops_step.BoundStep, "__init__", counted)
    alone(monkeypatch, body, start, given)
    assert len(made) == 1


def test_a_bound_energy_has_the_bits_of_the_op(monkeypatch):
    """At single places and many at once, and where a derivative is asked for."""
    monkeypatch.delitem(sys.modules, "torch._dynamo", raising=False)
    body, _ = activated()
    prepared = PreparedBody(body, body.physics(youngs_modulus=torch.tensor(35.0).double()))
    for shape in ((), (3,), (2, 2)):
        x = body.x_rest + 0.05 * noise(*shape, *body.x_rest.shape, seed=3)
        loads = check_loads(prepared, tuple(x.shape), {})
        bound = ElasticGradient(loads)
        wanted, energy = elastic_gradient(x, loads)
        with monkeypatch.context() as patch:
            patch.setattr(_ops_elastic, "elastic_gradient", None)
            for _ in range(2):  # nothing of the first call is left in the second
                found = bound(2.0 * x)
                found = bound(x)
        assert torch.equal(found[0], wanted)
        assert torch.equal(found[1], energy)
    place = leaf(x)
    gradient, energy = bound(place)
    assert torch.equal(gradient, wanted)
    (slope,) = torch.autograd.grad(energy.sum(), place)
    torch.testing.assert_close(slope, wanted)


@pytest.mark.grad
def test_the_energy_beside_a_gradient_has_slopes_by_a_field_of_stiffness():
    """Both modes were right in positions alone: stiffening by strain had an adjoint 2 % off where
    the modulus differs from element to element."""
    body, _ = activated()
    x = body.x_rest + 0.05 * noise(2, *body.x_rest.shape, seed=3)
    modulus = 30.0 + noise(body.mesh.num_elements, seed=4)
    along, weights = noise(body.mesh.num_elements, seed=5), torch.tensor([0.3, -0.7]).double()

    def energy(modulus):
        loads = check_loads(PreparedBody(body, body.physics(youngs_modulus=modulus)), x.shape, {})
        return weights @ elastic_gradient(x, loads)[1]

    rise = (energy(modulus + 1e-4 * along) - energy(modulus - 1e-4 * along)) / 2e-4
    slope = torch.func.grad(energy)(modulus)
    _, rate = torch.func.jvp(energy, (modulus,), (along,))
    torch.testing.assert_close(slope @ along, rise, rtol=1e-8, atol=0.0)
    torch.testing.assert_close(rate, rise, rtol=1e-8, atol=0.0)


def test_a_bound_energy_refuses_what_the_op_refuses():
    body, _ = forced()
    bound = ElasticGradient(check_loads(PreparedBody(body, None), tuple(body.x_rest.shape), {}))
    bad = body.x_rest.clone()
    for value in (float("nan"), float("inf")):
        bad[1, 2] = value
        with pytest.raises(ValueError, match="x must be finite, got 1 NaN or infinite"):
            bound(bad)
    with pytest.raises((TypeError, ValueError)):
        bound(body.x_rest[:-1])
    with pytest.raises(TypeError):
        bound(body.x_rest.float())


def test_a_body_is_prepared_anew_where_a_number_changed():
    body, _ = forced()
    first = prepare(body, None)
    assert prepare(body, None).physics is first.physics
    body.density.data.mul_(2.0)  # behind PyTorch's counters
    second = prepare(body, None)
    torch.testing.assert_close(second.physics.mass, 2.0 * first.physics.mass)
    state = body.rest_state()
    anew, _ = forced(density=body.density.clone())
    assert torch.equal(body(state).x, anew(state).x)
    body.dt = 0.5 * body.dt
    assert prepare(body, None)._terms.keys() != second._terms.keys()
    with pytest.raises(ValueError, match="density"):
        body.density.data.fill_(-1.0)
        body(state)


def test_what_is_kept_has_no_gradient_and_keeps_no_body():
    body, _ = forced(density=torch.nn.Parameter(leaf(900.0).detach()))
    with torch.no_grad():
        plain = prepare(body, None)
    followed = prepare(body, None)
    assert followed.physics is not plain.physics
    assert followed.physics.mass.requires_grad
    with torch.inference_mode():
        assert prepare(body, None).physics is not plain.physics
    assert pickle.loads(pickle.dumps(body)).kept is None
    gone = weakref.ref(body)
    gc.disable()
    try:
        del body, plain, followed
        assert gone() is None
    finally:
        gc.enable()


def test_ensembles_and_graphs_take_a_body():
    """A stack of bodies of one mesh is its loop; graphs ask no values; shapes have no gradient."""
    bodies = [
        forced(youngs_modulus=torch.nn.Parameter(torch.tensor(E).double()))[0] for E in (30.0, 45.0)
    ]
    start = bodies[0].rest_state()
    start = soft.State(start.x, 0.1 * noise(*start.x.shape, seed=6) * ~bodies[0].fixed)
    stacked = torch.func.stack_module_state(bodies)

    def run(parameters, buffers):
        return torch.func.functional_call(bodies[0], (parameters, buffers), (start,)).x

    together = torch.func.vmap(run)(*stacked)
    alone = torch.stack([body(start).x for body in bodies])
    assert not torch.equal(alone[0], alone[1])
    torch.testing.assert_close(together, alone, rtol=1e-12, atol=0.0)
    slopes = torch.func.vmap(torch.func.grad(lambda p, b: run(p, b).square().sum()))(*stacked)
    moduli = [body.youngs_modulus for body in bodies]
    loop = torch.autograd.grad(sum(body(start).x.square().sum() for body in bodies), moduli)
    torch.testing.assert_close(slopes["youngs_modulus"], torch.stack(loop), rtol=1e-12, atol=0.0)

    class Scene(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.body = bodies[0]

        def forward(self, x, v):
            return self.body(soft.State(x, v)).x

    graph = torch.export.export(Scene(), (start.x, start.v)).module()
    torch.testing.assert_close(graph(start.x, start.v), alone[0], rtol=1e-12, atol=0.0)

    def by_shape(x_rest):
        return torch.func.functional_call(bodies[0], {"x_rest": x_rest}, (start,)).x.sum()

    shapes = torch.stack([bodies[0].x_rest] * 2)
    with pytest.raises((NotImplementedError, ValueError), match="x_rest"):
        torch.func.vmap(torch.func.grad(by_shape))(shapes)
    with pytest.raises(ValueError, match="x_rest of a body must be its mesh's"):
        torch.func.vmap(by_shape)(1.1 * shapes)
