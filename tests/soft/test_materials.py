"""Hyperelastic materials: are energy, stress and tangent those of the formulas, and do steps,
statics and gradients hold with every one of them?"""

import math

import pytest
import torch

from diffsim import mesh, soft
from diffsim.core.errors import ConvergenceError, DiffsimError, InvertedElementError
from diffsim.soft._context import preconditioner_stiffness
from tests.gradients import check_directions
from tests.soft.cases import (
    SHARP,
    deformed,
    irregular_mesh,
    leaf,
    noise,
    soft_body,
)
from tests.soft.test_reference import close as close_to_reference
from tests.soft.test_reference import load, make_mesh, reference_mass
from tests.soft.test_step_gradients import (
    STRETCHES,
    TOLERANCE,
    layer_of,
    one_tet,
)

MATERIALS = [m for m in soft.MATERIALS if m != "pd"]
NEEDS_POSITIVE_J = ["neo_hookean", "mooney_rivlin"]  # finite but where elements are inverted
FINITE = [m for m in MATERIALS if m not in NEEDS_POSITIVE_J]
KINDS = ["hex", "tet"]
MU, LAMBDA = 30.0 / 2.6, 30.0 * 0.3 / (1.3 * 0.4)  # of E = 30 Pa, nu = 0.3


def close(actual, expected, tol):
    torch.testing.assert_close(actual, expected, rtol=tol, atol=tol)


def signed_stretches(F):
    s = torch.linalg.svdvals(F)
    return torch.cat([s[:2], s[2:] * torch.sign(torch.linalg.det(F.detach()))])


def energy_density(material, F, mu=MU, lame_lambda=LAMBDA):
    """The textbook formulas, in F where they have one."""
    eye, J, square = torch.eye(3).double(), torch.linalg.det(F), (F * F).sum()
    if material == "corotated":
        e = signed_stretches(F) - 1.0
        return mu * (e * e).sum() + lame_lambda / 2 * e.sum() ** 2
    if material == "stable_neo_hookean":  # Smith et al. 2018, eq. 14, with eq. 16's constants
        m, bulk = 4.0 / 3.0 * mu, lame_lambda + 5.0 / 6.0 * mu
        alpha = 1.0 + m / bulk - m / (4.0 * bulk)
        rest = bulk / 2 * (1.0 - alpha) ** 2 - m / 2 * math.log(4.0)
        return (
            m / 2 * (square - 3)
            + bulk / 2 * (J - alpha) ** 2
            - m / 2 * torch.log(square + 1)
            - rest
        )
    if material == "neo_hookean":
        return mu / 2 * (square - 3) - mu * torch.log(J) + lame_lambda / 2 * torch.log(J) ** 2
    if material == "mooney_rivlin":  # with 0.3 of mu/2 in c2, see tests/soft/cases.py
        C, c1, c2 = F.T @ F, 0.7 * mu / 2, 0.3 * mu / 2
        second = (C.trace() ** 2 - (C * C).sum()) / 2
        bulk = lame_lambda - 4.0 * c2
        logarithms = bulk / 2 * torch.log(J) ** 2 - 2 * (c1 + 2 * c2) * torch.log(J)
        return c1 * (square - 3) + c2 * (second - 3) + logarithms
    green = (F.T @ F - eye) / 2
    return mu * (green * green).sum() + lame_lambda / 2 * green.trace() ** 2


def tet_of(F, material, **changes):
    """One tetrahedron, its volume, and its nodes under F."""
    body, _ = one_tet((1.0, 1.0, 1.0), material=material, **changes)
    return body, float(body.nodal_volume.sum()), body.x_rest @ F.T


def random_F(seed, material):
    F = torch.eye(3).double() + 0.9 * noise(3, 3, seed=seed)
    if material in NEEDS_POSITIVE_J and torch.linalg.det(F) <= 0:
        F[:, 0] = -F[:, 0]
    return F


@pytest.mark.reference
@pytest.mark.parametrize("material", MATERIALS)
def test_energy_stress_and_tangent_are_those_of_the_formula(material):
    """30 random F, about a third of them inverted: to 1e-10 of each quantity's size."""
    flipped = 0
    for seed in range(30):
        F = random_F(seed, material)
        flipped += int(torch.linalg.det(F) < 0)
        body, volume, x = tet_of(F, material)
        x, direction = leaf(x), noise(4, 3, seed=100 + seed)

        def energy(x, body=body, volume=volume):
            rest, now = (p[1:] - p[0] for p in (body.x_rest, x))
            return volume * energy_density(material, torch.linalg.solve(rest, now).T)

        expected = energy(x)
        (gradient,) = torch.autograd.grad(expected, x, create_graph=True)
        (product,) = torch.autograd.grad((gradient * direction).sum(), x)
        force = body.elastic_force(x)
        (tangent,) = torch.autograd.grad(-force, x, direction)
        assert abs(body.elastic_energy(x) - expected) <= 1e-10 * (1.0 + abs(expected))
        assert (force + gradient).abs().max() <= 1e-10 * (1.0 + gradient.abs().max())
        assert (tangent - product).abs().max() <= 1e-10 * (1.0 + product.abs().max())
    assert flipped == 0 if material in NEEDS_POSITIVE_J else flipped > 5


@pytest.mark.reference
@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("size", [1e-3, 1e-6, 1e-9])
def test_small_strain_energies_keep_their_digits(material, size):
    """mu |e|^2 + lambda/2 tr(e)^2, apart from terms of third order: the energy is of size e^2,
    which differences of first-order terms would drown at e = 1e-9."""
    e = torch.tensor([0.7, -0.4, 0.2], dtype=torch.float64) * size
    body, volume, x = tet_of(torch.diag(1.0 + e), material)
    linear = MU * (e * e).sum() + LAMBDA / 2 * e.sum() ** 2
    # F itself carries rounding of 1e-16 of 1, a relative error of 1e-16 / e of the strain.
    close(
        body.elastic_energy(x) / volume / linear, torch.ones(()).double(), 5 * size + 1e-15 / size
    )


def of_a_small_pull(kind, ratio, **changes) -> tuple[float, float]:
    """E from force over area and nu from the sides of a bar that is pulled by 1e-6."""
    box = (mesh.hex_box if kind == "hex" else mesh.tet_box)((3, 1, 1), (3.0, 1.0, 1.0))
    x = box.x_rest
    mask = torch.zeros(box.num_nodes, 3, dtype=torch.bool)
    mask[:, 0] = (x[:, 0] == 0) | (x[:, 0] == 3)
    for axis in (1, 2):  # planes of symmetry: free to slide, not to drift
        mask[:, axis] = x[:, axis] == 0
    body = soft_body(box, poissons_ratio=ratio, fixed=mask, gravity=(0.0, 0.0, 0.0), **changes)
    strain = 1e-6
    target = x + strain * x * torch.tensor([1.0, 0.0, 0.0]).double()
    found = body.static_equilibrium(dirichlet_target=target).x
    force = -body.elastic_force(found)[x[:, 0] == 3, 0].sum()
    side = (found - x)[x[:, 1] == 1, 1].mean()
    return float(force) / strain, -float(side) / strain


@pytest.mark.reference
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("ratio", [-0.6, 0.0, 0.3, 0.48])
@pytest.mark.parametrize("material", [*MATERIALS, "pd"])
def test_small_strains_recover_the_constants(material, ratio, kind):
    """Exact to the strain."""
    if material == "pd" and ratio < 0:
        pytest.skip("projective dynamics needs nu >= 0")
    youngs_modulus, found = of_a_small_pull(kind, ratio, material=material)
    assert abs(youngs_modulus / 30.0 - 1.0) < 2e-5
    assert abs(found - ratio) < 2e-5


@pytest.mark.reference
@pytest.mark.parametrize("kind", KINDS)
def test_thesis_weights_soften(kind):
    """lambda / 3 in place of lambda: E' = mu (3 l + 2 mu) / (l + mu) and nu' = l / (2 (l + mu))."""
    youngs_modulus, ratio = of_a_small_pull(kind, 0.45, volume_weight="thesis")
    assert ratio == pytest.approx(0.375, abs=1e-4)
    assert youngs_modulus == pytest.approx(0.9483 * 30.0, rel=2e-4)


@pytest.mark.reference
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["corotated", "neohookean"])
def test_static_reference_vectors(name, kind):
    d = load("materials_static")
    m = make_mesh(kind, d, {"hex": "hexes", "tet": "tets"}[kind])
    body = soft.SoftBody(
        m,
        dt=1e-2,
        youngs_modulus=float(d["E"]),
        poissons_ratio=float(d["nu"]),
        material={"corotated": "corotated", "neohookean": "neo_hookean"}[name],
    )
    q = d["q"].reshape(-1, 3).clone().requires_grad_()
    force = body.elastic_force(q)
    close_to_reference(body.elastic_energy(q).reshape(1), d[f"{kind}_{name}_energy"])
    close_to_reference(force.flatten(), d[f"{kind}_{name}_force"])
    (dforce,) = torch.autograd.grad(force, q, d["dq"].reshape(-1, 3))
    close_to_reference(dforce.flatten(), d[f"{kind}_{name}_dforce"])


def reference_body(kind, d, **changes):
    m = make_mesh(kind, d, {"hex": "hexes", "tet": "tets"}[kind])
    return soft.SoftBody(
        m,
        dt=float(d["h"]),
        youngs_modulus=float(d["E"]),
        poissons_ratio=float(d["nu"]),
        material="neo_hookean",
        masses=soft.Masses(node_mass=reference_mass(m, d)),
        **{"fixed": d["fixed_nodes"], "solver": soft.SolverOptions(**SHARP), **changes},
    )


@pytest.mark.reference
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("num_steps", [1, 10])
def test_neo_hookean_reference_states_and_gradients(num_steps, kind):
    d = load("neohookean")
    body = reference_body(kind, d)
    key = f"{kind}_N{num_steps}_"
    gravity = d["gravity"].clone().requires_grad_()
    x0 = d["q0"].reshape(-1, 3).clone().requires_grad_()
    v0 = d["v0"].reshape(-1, 3).clone().requires_grad_()
    force = d["f_ext"].reshape(-1, 3).clone().requires_grad_()
    final = soft.rollout(
        body,
        soft.State(x0, v0),
        num_steps,
        external_force=force,
        physics=body.physics(gravity=gravity),
    ).final
    close_to_reference(final.x.flatten(), d[key + "q"])
    close_to_reference(final.v.flatten(), d[key + "v"], 1e-8)
    loss = (final.x.flatten() * d["wq"]).sum() + (final.v.flatten() * d["wv"]).sum()
    close_to_reference(loss.reshape(1), d[key + "loss"], 1e-8)
    loss.backward()
    free = ~body.fixed.flatten()
    close_to_reference(x0.grad.flatten()[free], d[key + "dq0"][free], 1e-8)
    close_to_reference(v0.grad.flatten()[free], d[key + "dv0"][free], 1e-8)
    close_to_reference(force.grad.flatten()[free], d[key + "df_ext_sum"][free], 1e-8)
    close_to_reference(gravity.grad, d[key + "dgravity"], 1e-8)


@pytest.mark.reference
def test_neo_hookean_reference_static():
    d = load("neohookean")
    held = torch.unique(torch.cat([d["static_held"], d["fixed_nodes"]]))
    # Rounding of the twisted end's forces is 1e-12 of the load, which is the scale here.
    solver = soft.SolverOptions(method="newton_cholesky", rtol=1e-10)
    body = reference_body("hex", d, fixed=held, gravity=(0.0, 0.0, 0.0), solver=solver)
    target = body.x_rest.clone()
    target[d["static_held"]] = d["static_held_pos"]
    # The prescribed end lies within an element's height of its neighbors: start from a shape that
    # follows it, as the whole bar twisted and pulled would.
    start = blend(body.x_rest, d)
    found = body.static_equilibrium(
        guess=start, dirichlet_target=target, external_force=d["static_f_ext"].reshape(-1, 3)
    )
    close_to_reference(found.x.flatten(), d["hex_static_q"])


def blend(x, d):
    """The bar twisted about its axis by pi/6 and pulled by a tenth, in proportion to x."""
    length = x[:, 0].max()
    center = x[:, 1:].mean(0)
    angle = math.pi / 6 * x[:, 0] / length
    y, z = (x[:, 1:] - center).unbind(1)
    turned = [y * angle.cos() - z * angle.sin(), y * angle.sin() + z * angle.cos()]
    return torch.cat([1.1 * x[:, :1], torch.stack(turned, 1) + center], 1)


@pytest.mark.grad
@pytest.mark.parametrize("name", [*STRETCHES, "three_equal", "nearly_equal"])
@pytest.mark.parametrize("material", ["pd", *MATERIALS])
def test_elastic_force_of_hard_elements(material, name):
    """Equal, nearly equal, tiny and negative stretches: closed forms have no 0/0."""
    extra = {"three_equal": (1.2, 1.2, 1.2), "nearly_equal": (1.1, 1.1 - 1e-9, 1.1 - 2e-9)}
    stretch = {**STRETCHES, **extra}[name]
    body, x = one_tet(stretch, material=material)
    if material in NEEDS_POSITIVE_J and stretch[2] < 0:
        with pytest.raises(InvertedElementError, match="1 of 1 elements are inverted"):
            body.elastic_force(x)
        return
    if material in NEEDS_POSITIVE_J and name in ("flat", "thin", "needle"):
        pytest.skip("ln J varies faster than any difference step; see the next test")

    def layer(x, youngs_modulus, poissons_ratio):
        physics = body.physics(youngs_modulus=youngs_modulus, poissons_ratio=poissons_ratio)
        return body.elastic_force(x, physics=physics)

    # Third derivatives: of ln J 1e5 at a stretch of 0.02, of the nearest rotation 1e6 at the
    # needle, times eps^2 = 1e-14.
    options = {"eps": 1e-7, "atol": 1e-4 if material == "pd" else 2e-4, "rtol": 1e-5}
    args = (leaf(x), leaf(30.0), leaf(0.3))
    assert torch.autograd.gradcheck(layer, args, **options)

    def energy(x, youngs_modulus, poissons_ratio):
        physics = body.physics(youngs_modulus=youngs_modulus, poissons_ratio=poissons_ratio)
        return body.elastic_energy(x, physics=physics)

    assert torch.autograd.gradcheck(energy, args, check_forward_ad=True, **options)
    # The force is the negative gradient of the energy, to the last bit.
    (slope,) = torch.autograd.grad(body.elastic_energy(args[0]), args[0])
    torch.testing.assert_close(slope, -layer(*args).detach(), rtol=0, atol=0)


@pytest.mark.grad
@pytest.mark.parametrize("stretch", [(1.4, 1e-2, 1e-3), (1.5, 0.8, 1e-3), (0.5, 1e-6, 1e-7)])
def test_neo_hookean_of_nearly_flat_elements(stretch):
    """Stress and tangent in principal axes against the formula's, at s = 1e-7."""
    s = leaf(torch.tensor(stretch))
    body, volume, x = tet_of(torch.diag(s.detach()), "neo_hookean")
    gradient, *_ = torch.autograd.grad(energy_density("neo_hookean", torch.diag(s)), s)
    rest = body.x_rest[1:] - body.x_rest[0]
    piola = -body.elastic_force(x)[1:].T @ rest / volume
    # The nodes' coordinates carry 1e-16, which is 1e-9 of the smallest stretch.
    close(piola.diagonal() / gradient, torch.ones(3).double(), 1e-8)


@pytest.mark.grad
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("material", FINITE)
def test_steps_from_inverted_elements(material, kind):
    """A body pushed inside out recovers, and the step has its gradient. Light time steps keep some
    elements inverted, so that their tangent is used."""
    m = irregular_mesh(kind, (1, 1, 1), (1.0, 1.0, 1.0))
    body = soft_body(m, material=material, dt=0.02, fixed=torch.tensor([0, 1]))
    x = m.x_rest.clone()
    x[-1] -= 2.6 * (x[-1] - x[:-1].mean(0))
    assert inverted(body, x) > 0
    after = body(soft.State(x, torch.zeros_like(x)))
    assert inverted(body, after.x) > 0
    names = ("x", "v", "youngs_modulus", "poissons_ratio")
    args = (leaf(x), leaf(0.1 * noise(m.num_nodes, 3)), leaf(30.0), leaf(0.3))
    check_directions(layer_of(body, names, 1), args, **TOLERANCE)


def inverted(body, x):
    from diffsim.core.compiled import core

    return core.count_inverted(body._context.pattern, x.contiguous().data_ptr())


@pytest.mark.parametrize("method", ["auto", "quasi_newton", "newton_cholesky"])
@pytest.mark.parametrize("material", NEEDS_POSITIVE_J)
def test_line_search_goes_on_after_a_trial_without_energy(material, method):
    """A blow that would push every full Newton step through the floor of ln J."""
    m = mesh.hex_box((2, 2, 2))
    held = m.nodes_near_plane("z", 0.0)
    body = soft_body(
        m,
        material=material,
        fixed=held,
        dt=0.2,
        solver=soft.SolverOptions(method=method, rtol=1e-8),
    )
    v = torch.zeros_like(m.x_rest)
    v[:, 2] = -8.0 * m.x_rest[:, 2]  # y = x + h v lies below the floor
    state = body(soft.State(m.x_rest, v))
    assert inverted(body, m.x_rest + 0.2 * v) > 0
    assert inverted(body, state.x) == 0
    assert state.x[:, 2].max() < 0.7


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("material", NEEDS_POSITIVE_J)
def test_an_inverted_start_is_refused_with_advice(material, kind):
    m = irregular_mesh(kind, (2, 1, 1))
    body = soft_body(m, material=material, fixed=torch.tensor([0, 1, 2, 3]))
    x = m.x_rest.clone()
    x[-1] = x[-1] - 3.0
    words = r"[1-9]\d* of \d+ elements are inverted.*material='stable_neo_hookean'"
    for call in (
        lambda: body(soft.State(x, torch.zeros_like(x))),
        lambda: body.static_equilibrium(guess=x),
        lambda: body.elastic_force(x),
        lambda: body.elastic_energy(torch.stack([m.x_rest, x])),
    ):
        with pytest.raises(InvertedElementError, match=words) as caught:
            call()
        assert caught.value.num_inverted > 0
        assert isinstance(caught.value, DiffsimError)
        assert not isinstance(caught.value, ConvergenceError)
    stable = soft_body(m, material="stable_neo_hookean", fixed=torch.tensor([0, 1, 2, 3]))
    assert stable(soft.State(x, torch.zeros_like(x))).x.isfinite().all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("method", ["auto", "quasi_newton"])
def test_prescribed_motion_may_exceed_an_element(method, kind):
    """The clamp moves by more than the height of the elements beside it: alone it would invert
    them, so the body is made to follow. Mirrored, no path is left."""
    m = (mesh.hex_box if kind == "hex" else mesh.tet_box)((4, 2, 2), (2.0, 1.0, 1.0))
    held = m.nodes_near_plane("x", 0.0)
    options = {"material": "neo_hookean", "gravity": (0.0, 0.0, 0.0)}
    solver = soft.SolverOptions(method=method, rtol=1e-8)
    body = soft_body(m, fixed=held, solver=solver, **options)
    target = m.x_rest + torch.tensor([0.8, 0.0, 0.0]).double()  # cells are 0.5 long
    moved = m.x_rest.clone()
    moved[held] = target[held]
    assert inverted(body, moved) > 0
    state = body(body.rest_state(), dirichlet_target=target)
    assert inverted(body, state.x) == 0
    close(state.x[held], target[held], 1e-15)
    # The answer is a minimum, however it was reached: forces balance.
    inertia = body.physics().mass[:, None] / 0.1**2
    residual = inertia * (state.x - m.x_rest) - body.elastic_force(state.x)
    assert residual[~body.fixed].norm() < 1e-6
    everything = soft_body(m, fixed=torch.arange(m.num_nodes), **options)
    mirrored = m.x_rest * torch.tensor([-1.0, 1.0, 1.0]).double()
    with pytest.raises(InvertedElementError, match=f"{m.num_elements} of {m.num_elements} element"):
        everything(everything.rest_state(), dirichlet_target=mirrored)


@pytest.mark.property
@pytest.mark.parametrize("material", ["pd", *MATERIALS])
def test_damping_is_beta_times_the_small_strain_stiffness(material):
    """f(x, v) - f(x, 0) = -beta K v at rest, K the tangent there."""
    m = irregular_mesh("hex")
    beta, v = 0.05, noise(m.num_nodes, 3, seed=6)
    options = {"material": material, "integrator": "semi_implicit_euler", "dt": 1e-3}
    damped, plain = soft_body(m, rayleigh_beta=beta, **options), soft_body(m, **options)
    rest = soft.State(m.x_rest, v)
    mass = plain.physics().mass[:, None]
    viscous = mass * (damped(rest).v - plain(rest).v) / 1e-3
    x = leaf(m.x_rest)
    (stiff,) = torch.autograd.grad(plain.elastic_force(x), x, v)
    close(viscous, beta * stiff, 1e-9)


@pytest.mark.parametrize("material", ["pd", *MATERIALS])
def test_the_constant_matrix_depends_on_the_small_strain_moduli_alone(material):
    body = soft_body(irregular_mesh("hex"), material=material)
    physics, none = body.physics(), torch.zeros(0).double()
    kappa, _ = preconditioner_stiffness(material, physics.weights, none, none, none)
    close(kappa, torch.full_like(kappa, 2.0 * MU + 0.3 * LAMBDA), 1e-12)


def test_bad_arguments():
    m = mesh.hex_box((1, 1, 1))
    with pytest.raises(ValueError, match="did you mean 'neo_hookean'"):
        soft_body(m, material="neohookean")
    with pytest.raises(ValueError, match="material must be one of"):
        soft_body(m, material="rubber")
    with pytest.raises(ValueError, match=r"poissons_ratio must lie in \[0, .*stable_neo_hookean"):
        soft_body(m, poissons_ratio=-0.1)
    for ratio in (-1.0, 0.5):
        with pytest.raises(ValueError, match=r"poissons_ratio must lie in \(-1, 0.5\)"):
            soft_body(m, material="stvk", poissons_ratio=ratio)
    with pytest.raises(ValueError, match="volume_weight must be 'small_strain' for material"):
        soft_body(m, material="corotated", volume_weight="thesis")
    with pytest.raises(ValueError, match="for material 'pd', the body has 'stvk'"):
        body = soft_body(m, material="stvk")
        body(body.rest_state(), physics=soft_body(m).physics())


@pytest.mark.grad
@pytest.mark.parametrize("material", soft.MATERIALS)
def test_element_parameters_from_the_constants(material):
    constants = (leaf(30.0), leaf(0.3))
    constants += (leaf(0.3),) * len(soft.Material(material).constants)

    def weights_of(*values):
        names = soft.Material(material).constants
        return soft.Material(material).weights(
            *values[:2], **dict(zip(names, values[2:], strict=True))
        )

    w_mu, w_vol, *others = weights_of(*constants)
    w_mu = w_mu + sum(others)
    close(w_mu, torch.tensor(2.0 * MU, dtype=torch.float64), 1e-12)
    close(
        w_vol, torch.tensor((3.0 if material == "pd" else 1.0) * LAMBDA, dtype=torch.float64), 1e-12
    )
    assert torch.autograd.gradcheck(weights_of, constants)


@pytest.mark.reference
@pytest.mark.parametrize("stretch", [0.5, 1.5, 3.0])
def test_mooney_rivlin_in_uniaxial_stretch(stretch):
    """Rivlin 1948: pulled at constant volume, true stresses along and across differ by
    2 (s^2 - 1/s) (c1 + c2/s)."""
    side = stretch**-0.5
    material = soft.Material("mooney_rivlin", second_share=0.3)
    F = torch.diag(torch.tensor([stretch, side, side], dtype=torch.float64))
    body, volume, x = tet_of(F, material)
    piola = -body.elastic_force(x).T @ body.x_rest / volume
    c1, c2 = 0.7 * MU / 2, 0.3 * MU / 2
    expected = 2.0 * (stretch**2 - 1.0 / stretch) * (c1 + c2 / stretch)
    assert float(stretch * piola[0, 0] - side * piola[1, 1]) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_mooney_rivlin_without_a_second_invariant_is_neo_hookean(kind):
    m = irregular_mesh(kind)
    x = deformed(m, 0.1)
    bodies = [
        soft_body(m, material=soft.Material("mooney_rivlin")),
        soft_body(m, material="neo_hookean"),
    ]
    close(*(body.elastic_energy(x) for body in bodies), 1e-12)
    close(*(body.elastic_force(x) for body in bodies), 1e-12)


def test_the_second_share_is_checked():
    m = mesh.hex_box((1, 1, 1))
    with pytest.raises(ValueError, match=r"second_share must lie in \[0, 1\]"):
        soft_body(m, material=soft.Material("mooney_rivlin", second_share=1.2))
    with pytest.raises(ValueError, match="second_share is a constant of material='mooney_rivlin'"):
        soft.Material("stvk", second_share=0.1)
    with pytest.raises(ValueError, match="physics override"):
        soft_body(m).physics(second_share=0.1)
