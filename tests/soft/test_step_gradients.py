"""Is every gradient of a soft body exact? Central differences, float64, meshes of a few elements.

Tolerance of gradcheck: the differences are over 2e-6; the solver stops at 1e-12 of the force scale,
which is 1e-6 of a difference, and third derivatives add 1e-12. Entries are of order one: 2e-5.
"""

import copy
import pickle

import pytest
import torch

from diffsim import mesh, soft
from diffsim.soft.step import step_in_water
from tests.gradients import check_directions
from tests.soft.cases import (
    SHARP,
    deformed,
    irregular_mesh,
    leaf,
    noise,
    rail_mask,
    soft_body,
    two_muscles,
)

pytestmark = pytest.mark.grad
TOLERANCE = {"eps": 1e-6, "atol": 2e-5, "rtol": 2e-5, "check_forward_ad": True}
INTEGRATORS = ["implicit_euler", "bdf2", "implicit_midpoint", "semi_implicit_euler"]
METHODS = ["auto", "quasi_newton", "newton_pcg", "newton_jacobi", "newton_cholesky"]
STATE_INPUTS = ("x", "v", "external_force", "activation", "dirichlet_target")


def layer_of(body, names, num_steps=2):
    """The final state of a short rollout as a function of the named inputs."""

    def layer(*args):
        given = dict(zip(names, args, strict=True))
        state = soft.State(
            given.pop("x", body.x_rest), given.pop("v", torch.zeros_like(body.x_rest))
        )
        signals = {k: given.pop(k) for k in STATE_INPUTS[2:] if k in given}
        physics = body.physics(**given)
        for _ in range(num_steps):
            state = soft.step(body, state, physics=physics, **signals)
        return torch.cat([state.x.flatten(), 0.1 * state.v.flatten()])

    return layer


@pytest.mark.parametrize("rayleigh_beta", [0.0, 0.02])
@pytest.mark.parametrize("method", ["auto", "linearly_implicit"])
def test_a_step_of_constant_parameters_is_one_node(method, rayleigh_beta):
    """Its adjoint is written by hand: that of the parts, where a parameter has a gradient, too."""
    m = irregular_mesh("hex", (2, 1, 1), (1.0, 1.0, 1.0))
    fixed = rail_mask(m)
    body = soft_body(
        m,
        fixed=fixed,
        muscles=two_muscles()[:1],  # the other one's stiffness depends on the activation
        rayleigh_alpha=0.4,
        rayleigh_beta=rayleigh_beta,
        solver=soft.SolverOptions(method=method, **SHARP),
    )
    shape = (m.num_nodes, 3)
    x = torch.where(fixed, m.x_rest, deformed(m))
    # an axis of a batch on the state, none on what acts on it
    args = [leaf(t.expand(2, *shape)) for t in (x, 0.3 * noise(*shape, seed=2))]
    target = m.x_rest + 0.1 * noise(*shape, seed=4)
    args += map(leaf, (0.2 * noise(*shape, seed=3), [0.8], target))
    own = {"rayleigh_beta": leaf(rayleigh_beta)}
    signals = dict(zip(STATE_INPUTS[2:], args[2:], strict=True))
    ends, grads = [], []
    for physics in (None, body.physics(**own)):
        end = soft.step(body, soft.State(*args[:2]), physics=physics, **signals)
        is_whole = end.x.grad_fn is end.v.grad_fn
        assert is_whole == (physics is None)
        out = torch.cat([end.x.flatten(), 0.1 * end.v.flatten()])
        grads.append(torch.autograd.grad(out, args, noise(out.numel(), seed=8)))
        ends.append(out.detach())
    assert torch.equal(*ends)
    for name, whole, parts in zip(STATE_INPUTS, *grads, strict=True):
        assert whole.abs().max() > 1e-6, name
        # they add in another order: a few units of the last place
        torch.testing.assert_close(whole, parts, rtol=1e-12, atol=1e-13 * float(parts.abs().max()))


@pytest.mark.parametrize("kind", ["hex", "tet"])
@pytest.mark.parametrize("method", ["auto", "linearly_implicit"])
def test_a_step_in_constant_water_is_one_node(kind, method):
    """Its adjoint is that of the force and of the step; so are those that are not one node."""
    m = irregular_mesh(kind, (2, 1, 1), (1.0, 1.0, 1.0))
    muscles = [soft.Muscle(elements=[0, 1], direction=(1.0, 0.0, 0.0), stiffness=20.0)]
    body = soft_body(m, muscles=muscles, solver=soft.SolverOptions(method=method, **SHARP))
    water = soft.Hydrodynamics(m, density=3.0, fade_angle=0.3).requires_grad_(False)
    shape = (2, m.num_nodes, 3)
    x = deformed(m).expand(shape)
    args = [leaf(x), leaf(0.5 * noise(*shape, seed=2)), leaf([[0.8], [1.1]])]
    velocity, gain = noise(2, 3, seed=3), torch.tensor([0.5, 2.0], dtype=torch.float64)
    around = {"water_velocity": velocity, "gain": gain[:, None, None]}

    def whole(x, v, activation, **changes):
        state = soft.State(x, v)
        return step_in_water(body, state, water, activation=activation, **(around | changes))

    def parts(x, v, activation):
        force = around["gain"] * water(x, v, water_velocity=velocity)
        return soft.step(body, soft.State(x, v), activation=activation, external_force=force)

    ends, grads = [], []
    for take in (whole, parts):
        end = take(*args)
        out = torch.cat([end.x.flatten(), 0.1 * end.v.flatten()])
        grads.append(torch.autograd.grad(out, args, noise(out.numel(), seed=8), retain_graph=True))
        ends.append(out.detach())
    assert torch.equal(*ends)
    for together, apart in zip(*grads, strict=True):
        assert together.abs().max() > 1e-6
        scale = float(apart.abs().max())  # they add in another order
        torch.testing.assert_close(together, apart, rtol=1e-12, atol=1e-13 * scale)
    end = whole(*args)
    inputs = {f.variable.data_ptr() for f, _ in end.x.grad_fn.next_functions if f is not None}
    assert inputs == {a.data_ptr() for a in args}  # nothing stands between
    with torch.no_grad():
        assert torch.equal(whole(*args).x, end.x)
    gain = leaf(around["gain"])  # by which the force has a derivative: two nodes again
    sums = [take.x[..., 0].sum() for take in (end, whole(*args, gain=gain))]
    by_v = [torch.autograd.grad(one, args[1], retain_graph=True)[0] for one in sums]
    torch.testing.assert_close(*by_v, rtol=1e-12, atol=1e-12)
    assert torch.autograd.grad(sums[1], gain)[0].abs().max() > 1e-6
    with pytest.raises(ValueError, match="external_force must be finite"):
        whole(*args, gain=torch.full((2, 1, 1), torch.nan, dtype=torch.float64))


def test_a_step_in_water_is_that_of_differences():
    """In both modes, and refused twice, as the step alone is."""
    m = irregular_mesh("hex", (1, 1, 1), (1.0, 1.0, 1.0))
    body = soft_body(m, solver=soft.SolverOptions(**SHARP))
    water = soft.Hydrodynamics(m, density=3.0, fade_angle=0.3).requires_grad_(False)
    args = (leaf(deformed(m)), leaf(0.5 * noise(m.num_nodes, 3, seed=2)))
    speed = noise(3, seed=3)

    def end(x, v):
        return step_in_water(body, soft.State(x, v), water, water_velocity=speed).x

    assert torch.autograd.gradcheck(end, args, **TOLERANCE, check_batched_grad=True)
    many = [torch.stack([a.detach(), a.detach()]) for a in args]
    mapped = torch.func.vmap(end)(*many)
    torch.testing.assert_close(mapped[0], end(*args).detach(), rtol=1e-12, atol=1e-12)
    (slope,) = torch.autograd.grad(end(*args).square().sum(), args[1], create_graph=True)
    with pytest.raises(NotImplementedError, match="second order"):
        torch.autograd.grad(slope.sum(), args[1])


def test_a_step_in_water_takes_the_force_that_the_water_has_now():
    """A factor of a subclass or a hook was passed over, and another angle came too late."""
    m = irregular_mesh("hex", (2, 1, 1), (1.0, 1.0, 1.0))
    body = soft_body(m, solver=soft.SolverOptions(**SHARP))
    state = soft.State(leaf(deformed(m)), 0.5 * noise(m.num_nodes, 3, seed=2))

    class Half(soft.Hydrodynamics):
        def forward(self, x, v, **given):
            return 0.5 * super().forward(x, v, **given)

    def end(water, gain=None):
        return step_in_water(body, state, water, gain=gain).x

    def of_parts(water, gain=1.0):
        return soft.step(body, state, external_force=gain * water(state.x, state.v)).x

    water, half = (
        of(m, density=3.0, fade_angle=0.3).requires_grad_(False)
        for of in (soft.Hydrodynamics, Half)
    )
    first = end(water)
    for one in (water, half, copy.deepcopy(water), pickle.loads(pickle.dumps(water))):
        assert torch.equal(end(one), of_parts(one))
    end(water, 0.5).sum().backward()  # a number is a gain, too
    assert torch.equal(end(water, 0.5), of_parts(water, 0.5))
    hook = water.register_forward_hook(lambda module, given, force: 2.0 * force)
    assert torch.equal(end(water), of_parts(water)) and not torch.equal(end(water), first)
    hook.remove()
    assert torch.equal(end(water), first)
    water.fade_angle = 0.6
    assert torch.equal(end(water), of_parts(water)) and not torch.equal(end(water), first)
    larger = irregular_mesh("hex", (2, 2, 1), (1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="x must have shape"):
        end(soft.Hydrodynamics(larger).requires_grad_(False))


# Principal stretches of one tetrahedron, away from the kink s1 + s2 = 0 of the nearest rotation and
# from s1 = s2 of a strongly expanded element (see test_at_the_kinks).
STRETCHES = {
    "rest": (1.0, 1.0, 1.0),
    "two_equal": (1.3, 1.3, 0.6),
    "thin": (1.5, 0.8, 1e-3),
    "flat": (1.2, 0.9, 0.0),
    "needle": (1.4, 1e-2, 1e-3),
    "inverted": (1.3, 0.9, -0.4),
    "inverted_needle": (1.1, 0.3, -0.05),
    "expanded": (4.0, 3.0, 2.5),
    "crushed": (0.05, 0.04, 0.02),
}


def one_tet(stretch, volume_weight="small_strain", **changes):
    """One right-handed tetrahedron and its nodes under F = U diag(stretch) V^T."""
    x = torch.tensor([[0, 0, 0], [1.0, 0.1, 0], [0.2, 0.9, 0.1], [0, 0.3, 1.1]]).double()
    m = mesh.TetMesh(x, torch.tensor([[0, 1, 2, 3]]))
    body = soft_body(m, gravity=(0.0, 0.0, 0.0), volume_weight=volume_weight, **changes)
    rotations = [torch.linalg.qr(noise(3, 3, seed=k))[0] for k in (1, 2)]
    u, v = (q * torch.linalg.det(q) for q in rotations)
    deformation = u @ torch.diag(torch.tensor(stretch, dtype=torch.float64)) @ v.T
    return body, x @ deformation.T


@pytest.mark.parametrize("name", STRETCHES)
@pytest.mark.parametrize("method", ["auto", "newton_cholesky", "quasi_newton"])
def test_step_of_hard_elements(name, method):
    """A step that starts from a hard element; light nodes, so that it stays one: h^2 E / m is
    0.03."""
    body, x = one_tet(STRETCHES[name], dt=0.01, solver=soft.SolverOptions(method=method, **SHARP))
    names = ("x", "v", "youngs_modulus")
    args = (leaf(x), leaf(0.1 * noise(4, 3)), leaf(30.0))
    check_directions(layer_of(body, names, 1), args, eps=1e-7, atol=2e-4, rtol=1e-5)


def energy_by_search(stretch, w_mu, w_vol):
    """psi by brute force: the nearest determinant-one diagonal and the nearest rotation."""
    s = torch.tensor(sorted(map(abs, stretch), reverse=True), dtype=torch.float64)
    s[2] = s[2] * torch.tensor(stretch).double().sign().prod()
    center, reach = torch.zeros(2, dtype=torch.float64), 3.0
    for _ in range(3):  # each search on a grid about the last one's best point, 30 times finer
        logs = center[:, None] + reach * torch.linspace(-1, 1, 301, dtype=torch.float64)
        a, b = torch.meshgrid(*logs.exp(), indexing="ij")
        gap = (a - s[0]) ** 2 + (b - s[1]) ** 2 + (1 / (a * b) - s[2]) ** 2
        best = int(gap.argmin())
        center, reach = logs[[0, 1], [best // 301, best % 301]], reach / 30.0
    volume = gap.min()
    return 0.5 * w_mu * ((s - 1) ** 2).sum() + 0.5 * w_vol * volume


@pytest.mark.parametrize(
    "stretch", [(1.2, 0.5, -0.5), (0.7, 0.0, 0.0), (2.6, 2.6, 2.6), (3.0, 2.4, 2.4), (2, 2, 2)]
)
def test_at_the_kinks(stretch):
    """Where the projection is not unique the energy has a concave kink: no derivative exists.

    Two nearest rotations at s1 + s2 = 0; several nearest volume-preserving matrices at s1 = s2 of
    an
    element expanded beyond 2. What happens: energy and force are finite, the energy is right, and
    the
    force is that of one of the nearest points, so that -force . d bounds the energy's slope from
    above
    in every direction d. The tangent's entries are finite; along the kink's jump they are about
    -1e12 E, so a step's adjoint there ends in an error or a vanishing component, not in NaN.
    """
    body, x = one_tet(stretch)
    physics = body.physics()
    volume = float(body.nodal_volume.sum())
    w_mu, w_vol = physics.weights[:, 0].tolist()
    expected = volume * energy_by_search(stretch, w_mu, w_vol)
    # The last search's grid is 2e-5: quadratic near the minimum.
    torch.testing.assert_close(body.elastic_energy(x), expected, rtol=2e-5, atol=0)
    x = leaf(x)
    force = body.elastic_force(x)
    assert force.isfinite().all()
    step = 1e-5
    for seed in range(20):
        d = noise(4, 3, seed=seed)
        rise = (body.elastic_energy(x + step * d) - body.elastic_energy(x)) / step
        assert rise <= -(force * d).sum() + 1e3 * step  # 1e3: E times |d|^2, curvature from above
    (hessian_times,) = torch.autograd.grad(force, x, noise(4, 3))
    assert hessian_times.isfinite().all()


@pytest.mark.parametrize("method", METHODS)
def test_step_from_the_kink(method):
    """A step that starts exactly at the kink ends away from it, with an exact gradient."""
    body, x = one_tet((1.2, 0.5, -0.5), solver=soft.SolverOptions(method=method, **SHARP))
    v = leaf(noise(4, 3))
    layer = layer_of(body, ("x", "v"), 1)
    assert torch.autograd.gradcheck(lambda v: layer(x, v), (v,), **TOLERANCE)


def test_equal_contraction_activations_share_their_gradient():
    m = irregular_mesh("hex", (2, 1, 1))
    body = soft_body(m, muscles=two_muscles())
    x = deformed(m).expand(2, -1, -1)
    one, rows = leaf([0.8, 0.3]), leaf([[0.8, 0.3], [0.8, 0.3]])
    for activation in (one, rows):
        state = body(soft.State(x, torch.zeros_like(x)), activation=activation)
        (state.x * noise(2, *m.x_rest.shape)).sum().backward()
    torch.testing.assert_close(rows.grad.sum(0), one.grad, rtol=1e-12, atol=1e-12)
    assert rows.grad[0, 1] == rows.grad[1, 1]  # one value for all, so one share for each
    with pytest.raises(ValueError, match="contraction muscles must be the same"):
        body(
            soft.State(x, torch.zeros_like(x)),
            activation=torch.tensor([[1, 0.3], [1, 0.4]]).double(),
        )
    # What a length muscle does may differ.
    body(
        soft.State(x, torch.zeros_like(x)), activation=torch.tensor([[1, 0.3], [0.9, 0.3]]).double()
    )


def test_gradient_of_a_strided_cotangent():
    m = irregular_mesh("hex", (1, 1, 1))
    body = soft_body(m)
    x = leaf(deformed(m))
    for cotangent in (noise(3, 8).T, torch.ones(1, dtype=torch.float64).expand(8, 3) * 1.0):
        out = body(soft.State(x, torch.zeros_like(x))).x
        (strided,) = torch.autograd.grad(out, x, cotangent, retain_graph=True)
        (plain,) = torch.autograd.grad(out, x, cotangent.contiguous())
        torch.testing.assert_close(strided, plain, rtol=0, atol=0)
