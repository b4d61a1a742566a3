"""Do all solvers find the same answer, and do they say so when they do not?"""

import copy
import gc
import io
import pickle
import warnings
from dataclasses import replace

import pytest
import torch

from diffsim import mesh, soft
from diffsim.core.errors import (
    ConvergenceError,
    ConvergenceWarning,
    DiffsimError,
    FactorizationError,
)
from diffsim.soft import _context, _ops_step
from diffsim.soft._arrays import StepArrays
from tests.covering import covering
from tests.soft.cases import SHARP, deformed, irregular_mesh, leaf, noise, soft_body, two_muscles

pytestmark = pytest.mark.reference
METHODS = ["auto", "quasi_newton", "newton_pcg", "multigrid", "newton_jacobi", "newton_cholesky"]


def solver_of(method):
    """``newton_pcg`` on the constant factor, ``multigrid`` the same on multigrid."""
    chosen = {"newton_pcg": "constant", "multigrid": "multigrid"}.get(method, "auto")
    return {
        "method": "newton_pcg" if method == "multigrid" else method,
        "preconditioner": chosen,
    }


def options(method="auto", **changes):
    return soft.SolverOptions(**{**solver_of(method), **SHARP, **changes})


def bar(kind="hex", cells=(6, 2, 2), **changes):
    """A soft bar that bends visibly within a step."""
    m = (mesh.hex_box if kind == "hex" else mesh.tet_box)(cells, (1.0, 0.3, 0.3))
    defaults = {
        "youngs_modulus": 1e4,
        "poissons_ratio": 0.4,
        "density": 1000.0,
        "dt": 0.02,
        "gravity": (0.0, 0.0, -9.81),
        "fixed": m.nodes_near_plane("x", 0.0),
    }
    return soft_body(m, **{**defaults, **changes})


def step_and_gradients(body, state=None, physics=None):
    """Next state and gradients of a weighted sum of it to x, v and Young's modulus."""
    start = state or soft.State(
        body.x_rest + 0.01 * noise(*body.x_rest.shape), 0.5 * noise(*body.x_rest.shape, seed=1)
    )
    x, v = leaf(start.x), leaf(start.v)
    youngs_modulus = leaf(body.youngs_modulus.detach())
    end = body(soft.State(x, v), physics=body.physics(youngs_modulus=youngs_modulus))
    loss = (noise(*x.shape, seed=2) * end.x).sum()
    return [end.x, end.v, *torch.autograd.grad(loss, (x, v, youngs_modulus))]


@pytest.mark.parametrize("method", METHODS)
def test_the_residual_is_what_was_asked(method):
    """|grad g| recomputed here from forces alone."""
    rtol = 1e-7
    body = bar(solver=options(method, rtol=rtol))
    start = soft.State(body.x_rest + 0.01 * noise(*body.x_rest.shape), noise(*body.x_rest.shape))
    end = body(start)
    mass = body.physics().mass[:, None]
    weight = mass * body.gravity
    y = start.x + body.dt * start.v
    inertia = mass / body.dt**2
    residual = inertia * (end.x - y) - weight - body.elastic_force(end.x)
    free = ~body.fixed
    scale = (inertia * (y - y.mean(0)))[free].norm() + weight.expand_as(y)[free].norm()
    assert residual[free].norm() <= 1.001 * rtol * scale
    torch.testing.assert_close(end.x[body.fixed], body.x_rest[body.fixed], rtol=0, atol=0)


@pytest.mark.parametrize("kind", ["hex", "tet"])
@pytest.mark.parametrize("method", METHODS)
def test_threads_do_not_change_a_bit(method, kind):
    results = []
    for num_threads in (1, 2):
        body = bar(
            kind,
            (8, 4, 4),
            solver=options(method, rtol=1e-7, num_threads=num_threads),
            rayleigh_beta=1e-3,
        )
        batch = body.rest_state(3)
        batch = soft.State(batch.x, noise(*batch.x.shape))
        single = soft.State(batch.x[0], batch.v[0])
        results.append(step_and_gradients(body, single) + step_and_gradients(body, batch))
    for one, two in zip(*results, strict=True):
        torch.testing.assert_close(one, two, rtol=0, atol=0)


STARTS = {
    "mirrored": lambda x: x * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64),
    "inside_out": lambda x: -x,
    "flat": lambda x: x * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64),
    "point": lambda x: 0.0 * x,
    "random": lambda x: noise(*x.shape, seed=11),
    "huge": lambda x: 50.0 * x,
}


@covering(start=STARTS, method=METHODS, kind=["hex", "tet"])
def test_terrible_starts_recover(start, method, kind):
    """Implicit Euler over long steps from nonsense: each step meets its tolerance (else it
    raises)."""
    m = irregular_mesh(kind, (2, 2, 2), (1.0, 1.0, 1.0), 0.02)
    m = type(m)(m.x_rest - m.x_rest.mean(0), m.elements)
    body = soft_body(
        m,
        youngs_modulus=100.0,
        density=1.0,
        gravity=(0.0, 0.0, 0.0),
        dt=0.1,
        solver=options(method, rtol=1e-6, max_iters=2000),
    )
    state = soft.State(STARTS[start](m.x_rest), torch.zeros_like(m.x_rest))
    before = float(body.elastic_energy(state.x))
    for _ in range(60):
        state = body(state)
        assert state.x.isfinite().all()
    # A mirrored or inverted body can rest in a local minimum, but has lost most of its energy.
    assert float(body.elastic_energy(state.x)) < 0.3 * before


@pytest.mark.parametrize("method", METHODS)
def test_a_huge_step_is_the_static_answer(method):
    body = bar(youngs_modulus=1e6, dt=1e4, solver=options(method, rtol=1e-8))
    still = bar(youngs_modulus=1e6, solver=options("newton_cholesky")).static_equilibrium()
    moved = body(body.rest_state())
    # Residual 1e-8 of 900 N over the bar's stiffness, about 1e3 N/m.
    torch.testing.assert_close(moved.x, still.x, rtol=0, atol=1e-7)


@pytest.mark.parametrize("kind", ["hex", "tet"])
@pytest.mark.parametrize("method", METHODS)
def test_nearly_incompressible(method, kind):
    exact = bar(kind, (4, 2, 2), poissons_ratio=0.499, solver=options("newton_cholesky"))
    body = bar(
        kind,
        (4, 2, 2),
        poissons_ratio=0.499,
        solver=options(method, rtol=1e-8, adjoint_rtol=1e-8, max_iters=5000),
    )
    for one, other in zip(step_and_gradients(body), step_and_gradients(exact), strict=True):
        assert (one - other).norm() <= 1e-5 * max(1.0, float(other.detach().norm()))


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e9])
@pytest.mark.parametrize("method", METHODS)
def test_units_do_not_matter(method, scale):
    """Stiffness, density and forces in other units of force: the same motion."""
    body, reference = (
        bar(
            cells=(4, 2, 2),
            youngs_modulus=1e4 * s,
            density=1000.0 * s,
            solver=options(method, rtol=1e-9),
        )
        for s in (scale, 1.0)
    )
    found, expected = step_and_gradients(body), step_and_gradients(reference)
    for one, other in zip(found[:4], expected[:4], strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(found[4] * scale, expected[4], rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("youngs_modulus", [1e-9, 1e13])
@pytest.mark.parametrize("method", METHODS)
def test_extreme_stiffness(method, youngs_modulus):
    """Almost no stiffness: free fall. Almost rigid, held at one end: nothing moves."""
    body = bar(cells=(4, 2, 2), youngs_modulus=youngs_modulus, solver=options(method, rtol=1e-6))
    end = body(body.rest_state())
    free = ~body.fixed.any(1)
    if youngs_modulus < 1.0:
        fall = end.x[free, 2] - body.x_rest[free, 2]
        torch.testing.assert_close(fall, torch.full_like(fall, -9.81 * 0.02**2), rtol=1e-6, atol=0)
    else:  # rounding of the stiff forces is 1e-7 of the load
        # The cantilever's own sag is rho A g l^4 / (8 E I) = 1.6e-8 m; one step of 1 / w^2 of it,
        # at most.
        assert 1e-10 < (end.x - body.x_rest).abs().max() < 1.6e-8


@pytest.mark.parametrize("gravity", [0.0, 1e-3, 1e-6, 1e-9, 1e-12])
@pytest.mark.parametrize("method", METHODS)
def test_tiny_loads_are_solved_or_refused(method, gravity):
    """A slender stiff bar whose load drowns in its own rounding below about 1e-6 m/s^2."""
    m = mesh.hex_box((10, 2, 2), (1.0, 0.1, 0.1))
    body = soft_body(
        m,
        youngs_modulus=1e7,
        density=1000.0,
        gravity=(0.0, 0.0, -gravity),
        fixed=m.nodes_near_plane("x", 0.0),
        solver=options(method, rtol=1e-6, adjoint_rtol=1e-6),
    )
    try:
        sag = float((m.x_rest - body.static_equilibrium().x)[:, 2].max())
    except ConvergenceError as error:
        assert gravity <= 1e-6 and error.residual_norm > error.tolerance
        return
    # Flexibility on this mesh: 0.01043 m per m/s^2; rtol on its softest mode is 1e-4.
    assert sag == pytest.approx(0.01043 * gravity, rel=1e-3, abs=1e-15)


@pytest.mark.parametrize("method", METHODS)
def test_too_few_iterations_raise_with_the_numbers(method):
    body = bar(dt=0.2, solver=options(method, rtol=1e-10, max_iters=1))
    state = soft.State(body.x_rest, noise(*body.x_rest.shape))
    with pytest.raises(
        ConvergenceError, match=r"stopped after 1 iterations.*needed.*raise max_iters"
    ) as e:
        body(state)
    assert e.value.num_iters == 1
    assert e.value.residual_norm > e.value.tolerance > 0.0
    assert isinstance(e.value, DiffsimError)
    body = bar(dt=0.2, solver=options(method, rtol=1e-10, max_iters=1, on_failure="warn"))
    with pytest.warns(ConvergenceWarning, match="stopped after 1 iterations"):
        after = body(state)
    assert after.x.isfinite().all()


# Not auto or newton_cholesky: with a factor of the tangent two iterations are enough.
@pytest.mark.parametrize("method", ["quasi_newton", "newton_pcg", "newton_jacobi"])
def test_an_adjoint_that_does_not_converge_raises(method):
    body = bar(dt=0.2, solver=options(method, rtol=1e-8, adjoint_rtol=1e-10, adjoint_max_iters=2))
    x = leaf(body.x_rest)
    end = body(soft.State(x, noise(*x.shape)))
    with pytest.raises(
        ConvergenceError, match=r"adjoint solve stopped after .* loosen adjoint_rtol"
    ):
        (end.x * noise(*x.shape)).sum().backward()
    body = bar(
        dt=0.2,
        solver=options(
            method, rtol=1e-8, adjoint_rtol=1e-10, adjoint_max_iters=2, on_failure="warn"
        ),
    )
    end = body(soft.State(x, noise(*x.shape)))
    with pytest.warns(ConvergenceWarning, match="adjoint solve"):
        (end.x * noise(*x.shape)).sum().backward()


@pytest.mark.parametrize("kind", ["hex", "tet"])
@pytest.mark.parametrize("method", METHODS)
def test_the_adjoint_at_an_indefinite_point_solves_its_system_or_raises(method, kind):
    """soft_step_vjp at a strongly compressed x that is no minimum: H has negative eigenvalues.

    The gradient to the force is z = H^-1 b itself; H comes dense from elastic_force.
    """
    m = irregular_mesh(kind, (2, 1, 1), (1.0, 0.5, 0.5), 0.02)
    body = soft_body(m, fixed=torch.tensor([0, 1, 2, 3]), solver=options(method))
    x = m.x_rest * 0.4 + 0.03 * noise(*m.x_rest.shape)
    physics = body.physics()
    inertia = 0.05 * torch.ones(m.num_nodes, dtype=torch.float64)
    n = x.numel()
    stiffness = -torch.autograd.functional.jacobian(body.elastic_force, x).reshape(n, n)
    hessian = stiffness + torch.diag(inertia.repeat_interleave(3))
    free = ~body.fixed.flatten()
    block = hessian[free][:, free]
    eigenvalues = torch.linalg.eigvalsh(block)
    assert eigenvalues[0] < -0.1 < 0.1 < eigenvalues[-1]
    b = noise(1, *x.shape)
    empty = torch.zeros(0, dtype=torch.float64)
    zeros = torch.zeros_like(b)
    inputs = {"y": zeros, "force": zeros, "target": zeros, "guess": zeros, "inertia": inertia}
    inputs["weights"] = physics.weights
    inputs["activation"] = inputs["pressure"] = torch.zeros(1, 0, dtype=torch.float64)
    arrays = StepArrays(**{**dict.fromkeys(StepArrays.specs, empty), **inputs})
    solver = replace(options(method), adjoint_rtol=1e-10, adjoint_max_iters=2000)
    grads = _ops_step.soft_step.vjp(
        x[None], *arrays.tensors(), b, handle=body.handle, **solver.arguments()
    )
    z = grads[list(StepArrays.specs).index("force")].flatten()
    expected = torch.linalg.solve(block, b.flatten()[free])
    # 1e-10 of |b| over the smallest eigenvalue.
    smallest = float(eigenvalues.abs().min())
    assert (z[free] - expected).norm() <= 2e-10 * float(b.norm()) / smallest
    assert (z[~free] == 0).all()


@pytest.mark.parametrize("method", METHODS)
def test_a_singular_static_problem_is_refused(method):
    """Nothing holds the body: no displacement balances gravity, and A has no inverse."""
    body = bar(fixed=None, solver=options(method))
    with pytest.raises(FactorizationError, match="needs Dirichlet nodes"):
        body.static_equilibrium()


def test_a_changed_parameter_never_meets_an_old_factor():
    """One body through changes of dt, stiffness, density, fibers, damping, and a fresh one for
    each."""
    m = irregular_mesh("hex", (2, 1, 1))
    arguments = {"fixed": torch.tensor([0, 1]), "muscles": two_muscles()}
    state = soft.State(deformed(m), noise(*m.x_rest.shape))
    changes = [
        {"youngs_modulus": 30.0},
        {"youngs_modulus": 31.0},
        {"density": 1.5},
        {"density": 5.0},
        {"poissons_ratio": 0.1},
        {"rayleigh_beta": 0.01},
        {"rayleigh_beta": 0.5},
        {"rayleigh_alpha": 3.0},
        {"attached_mass": torch.ones(m.num_nodes).double()},
        {"youngs_modulus": 30.0},
        {"dt": 0.05},
        {"dt": 0.1},
        {"youngs_modulus": 1e-3},
    ]
    # One iteration shows the factor: the answer after it depends on A, the converged one does not.
    crude = {"solver": options("quasi_newton", rtol=1e-6, max_iters=1, on_failure="warn")}
    for settings in (crude, {"solver": options("newton_pcg")}):
        old = soft_body(m, **arguments, **settings)
        for change in changes:
            fresh = soft_body(m, **arguments, **settings, **change)
            old.dt = change.get("dt", 0.1)
            physics = old.physics(**{k: v for k, v in change.items() if k != "dt"})
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ConvergenceWarning)
                found, expected = old(state, physics=physics), fresh(state)
            torch.testing.assert_close(found.x, expected.x, rtol=0, atol=0)


def test_an_in_place_change_of_a_parameter_is_seen():
    """Optimizers write into parameters: the cache's key must be a copy."""
    m = irregular_mesh("hex", (2, 1, 1))
    stiffness = torch.nn.Parameter(torch.full((m.num_elements,), 30.0, dtype=torch.float64))
    body = soft_body(m, youngs_modulus=stiffness)
    state = soft.State(deformed(m), torch.zeros_like(m.x_rest))
    body(state)
    with torch.no_grad():
        stiffness.mul_(7.0)
    fresh = soft_body(m, youngs_modulus=210.0)
    torch.testing.assert_close(body(state).x, fresh(state).x, rtol=0, atol=1e-14)


def _saved(body):
    buffer = io.BytesIO()
    torch.save(body, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=False)


@pytest.mark.parametrize(
    "clone",
    [copy.deepcopy, lambda b: pickle.loads(pickle.dumps(b)), _saved],
    ids=["deepcopy", "pickle", "torch.save"],
)
@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_a_copied_body_is_the_same_and_independent(clone, kind):
    m = irregular_mesh(kind, (2, 1, 1))
    body = soft_body(
        m,
        fixed=torch.tensor([0, 1]),
        muscles=two_muscles(),
        youngs_modulus=torch.nn.Parameter(torch.tensor(30.0, dtype=torch.float64)),
    )
    twin = clone(body)
    assert twin.handle != body.handle
    state = soft.State(deformed(m), noise(*m.x_rest.shape))
    torch.testing.assert_close(twin(state).x, body(state).x, rtol=0, atol=0)
    with torch.no_grad():
        twin.youngs_modulus.mul_(3.0)
    expected = soft_body(m, fixed=torch.tensor([0, 1]), muscles=two_muscles(), youngs_modulus=90.0)
    del body
    gc.collect()
    torch.testing.assert_close(twin(state).x, expected(state).x, rtol=0, atol=0)


def test_a_graph_outlives_its_body():
    """A function that makes a body and returns a loss is a natural thing to write."""

    def loss(stiffness):
        body = bar(cells=(2, 1, 1), youngs_modulus=stiffness)
        return (body(body.rest_state()).x ** 2).sum()

    stiffness = leaf(1e4)
    value = loss(stiffness)
    gc.collect()
    value.backward()
    assert stiffness.grad.abs() > 0


def test_loading_a_state_dict_keeps_the_boundary_conditions():
    """The prepared solver knows the Dirichlet set and the rest shape; a state_dict must not change
    them behind its back."""
    m = irregular_mesh("hex", (2, 1, 1))
    held = soft_body(
        m,
        fixed=torch.tensor([0, 1]),
        youngs_modulus=torch.nn.Parameter(torch.tensor(60.0, dtype=torch.float64)),
    )
    free = soft_body(
        m,
        fixed=torch.tensor([5]),
        youngs_modulus=torch.nn.Parameter(torch.tensor(30.0, dtype=torch.float64)),
    )
    free.load_state_dict(held.state_dict())
    expected = soft_body(m, fixed=torch.tensor([5]), youngs_modulus=60.0)
    state = soft.State(deformed(m), torch.zeros_like(m.x_rest))
    torch.testing.assert_close(free(state).x, expected(state).x, rtol=0, atol=0)
    assert bool((free.fixed == expected.fixed).all())


def test_prepared_objects_die_with_their_body():
    def use(backward):
        body = soft_body(mesh.hex_box((2, 1, 1)), fixed=torch.arange(4))
        x = body.x_rest.clone().requires_grad_(backward)
        state = body(soft.State(x, torch.zeros_like(x)))
        if backward:
            state.x.sum().backward()

    gc.freeze()  # of what earlier tests left a worker looks through millions of objects
    try:
        before = len(_context.contexts)
        for backward in (False, True):
            use(backward)
            gc.collect()
            assert len(_context.contexts) == before
    finally:
        gc.unfreeze()


@pytest.mark.parametrize(
    ("method", "counter", "limit"),
    [
        # before lines were searched beyond the full step, and saddles left by L-BFGS: 80
        ("newton_cholesky", "num_factorizations", 50),
        ("auto", "num_factorizations", 8),  # 17
        ("newton_pcg", "num_solves", 500),  # 1746
        ("multigrid", "num_solves", 300),  # 207
    ],
)
def test_a_bar_that_buckles_within_a_step_takes_few_iterations(method, counter, limit):
    box = mesh.hex_box((24, 2, 2), (0.24, 0.02, 0.02))
    x = box.x_rest
    ends = (x[:, 0] == 0) | (x[:, 0] == x[:, 0].max())
    options = dict(dt=0.05, youngs_modulus=1e5, poissons_ratio=0.3, fixed=ends)
    target = x.clone()
    target[x[:, 0] > 0.23, 0] -= 0.024
    side = torch.zeros_like(x)
    side[:, 2] = 1e-5
    ended = {}
    for name in (method, "quasi_newton"):
        solver = soft.SolverOptions(**solver_of(name), rtol=1e-8)
        body = soft.SoftBody(box, solver=solver, **options)
        with soft.record_stats() as solves:
            end = soft.step(body, body.rest_state(), external_force=side, dirichlet_target=target).x
        ended[name] = end, solves[0]
    found, by_lbfgs = ended[method], ended["quasi_newton"]
    assert getattr(found[1], counter).item() <= limit
    middle = (x[:, 0] - 0.12).abs() < 1e-9
    assert abs((found[0] - x)[middle, 2].mean()) > 0.02  # a tenth of its length shorter: it bows
    torch.testing.assert_close(found[0], by_lbfgs[0], atol=1e-5, rtol=0)
    torch.testing.assert_close(found[1].energy, by_lbfgs[1].energy, atol=0, rtol=1e-6)
