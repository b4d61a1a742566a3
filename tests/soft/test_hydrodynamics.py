"""Drag and thrust against reference vectors, finite differences and terminal velocities; added mass
and buoyancy."""

import copy
import math
import warnings

import numpy as np
import pytest
import torch

from diffsim import mesh, soft
from tests.measured import data_folder
from tests.soft.cases import deformed, irregular_mesh, leaf, noise, soft_body


def close(actual, expected, tol=1e-9):
    """Relative to the largest entry: single entries can be arbitrarily small."""
    assert (actual - expected).abs().max() <= tol * expected.abs().max()


def case(kind, batch=()):
    """A deformed, moving body with faces in all directions: hydrodynamics, x and v."""
    m = irregular_mesh(kind)
    x = deformed(m) + 0.02 * noise(*batch, m.num_nodes, 3, seed=7)
    v = noise(*batch, m.num_nodes, 3, seed=8) + torch.tensor([0.4, -0.3, 0.6]).double()
    return m, x, v


def plate(kind, side=2.0):
    """A thin square plate normal to z."""
    box = mesh.hex_box if kind == "hex" else mesh.tet_box
    return box((2, 2, 1), (side, side, 0.1))


# reference vectors


@pytest.fixture(scope="module")
def reference():
    return {
        k: torch.from_numpy(v)
        for k, v in np.load(data_folder("soft_reference") / "hydro_hex.npz").items()
    }


def reference_hydro(d, drag, thrust, **options):
    m = mesh.hex_box((3, 2, 1), (0.3, 0.2, 0.1))
    torch.testing.assert_close(m.x_rest, d["X"], rtol=0, atol=1e-15)
    return soft.Hydrodynamics(
        m,
        density=float(d["rho"]),
        water_velocity=d["v_water"],
        drag_coefficients=drag,
        thrust_coefficients=thrust,
        **options,
    )


@pytest.mark.reference
@pytest.mark.parametrize("suffix", ["", "_clamped"])
def test_reference_forces_and_jacobians(reference, suffix):
    d = reference
    options = {"max_force": float(d["max_force_clamped"]), "warn": False} if suffix else {}

    def force(x, v, drag, thrust):
        hydro = reference_hydro(d, drag, thrust, limit="component", **options)
        return hydro(x.reshape(-1, 3), v.reshape(-1, 3)).flatten()

    args = (d["q"], d["v"], d["Cd"][:, 1].contiguous(), d["Ct"][:, 1].contiguous())
    f = force(*args)
    close(f, d["f" + suffix])
    dx, dv, d_drag, d_thrust = torch.autograd.functional.jacobian(force, args)
    close(dx, d["df_dq" + suffix])
    close(dv, d["df_dv" + suffix])
    # p = (Cd row-major, Ct row-major); abscissae are columns 0, 2, ... and have no effect there
    close(torch.cat([d_drag, d_thrust], 1), d["df_dp" + suffix][:, 1::2])
    assert (d["df_dp"][:, 0::2] == 0).all()
    if not suffix:
        close(dx @ d["dir_q"] + dv @ d["dir_v"], d["jvp"])
    else:
        assert (f.abs() == options["max_force"]).sum() > 10  # or the clamp was not tested


@pytest.mark.reference
def test_reference_faces_are_the_meshs(reference):
    ours = reference_hydro(reference, (0.0,) * 4, (0.0,) * 4).faces
    assert {frozenset(f) for f in ours.tolist()} == {
        frozenset(f) for f in reference["faces"].tolist()
    }


# closed forms


@pytest.mark.reference
@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_flat_plate_head_on(kind):
    m = plate(kind)
    hydro = soft.Hydrodynamics(m, density=800.0)
    v = torch.zeros_like(m.x_rest)
    v[:, 2] = 0.3
    total = hydro(m.x_rest, v).sum(0)
    # true area 4 m^2 (the published code doubles that of triangles); alpha = pi/2: last ordinates
    expected = -0.5 * 800.0 * 4.0 * (2.05 + 2.5) * 0.3**2
    torch.testing.assert_close(total, torch.tensor([0, 0, expected], dtype=torch.float64))


@pytest.mark.reference
@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_flat_plate_at_an_angle(kind):
    """Both splines at an angle of attack of 30 degrees, with the other faces turned off by v."""
    m = plate(kind)
    drag, thrust = [0.1, 0.4, 0.9, 2.0], [-1.0, 0.3, 0.7, 1.5]
    hydro = soft.Hydrodynamics(m, drag_coefficients=drag, thrust_coefficients=thrust)
    alpha = math.radians(30.0)
    water = torch.tensor([math.cos(alpha), 0.0, -math.sin(alpha)], dtype=torch.float64)
    top = hydro.mesh.x_rest[:, 2] > 0.05
    total = hydro(m.x_rest, torch.zeros_like(m.x_rest), water_velocity=water)
    t, s = 1 / 3, 1 / 2 + 1 / 6
    c_d = np.dot([(1 - t) ** 3, 3 * (1 - t) ** 2 * t, 3 * (1 - t) * t**2, t**3], drag)
    c_t = np.dot([(1 - s) ** 3, 3 * (1 - s) ** 2 * s, 3 * (1 - s) * s**2, s**3], thrust)
    alpha_edge = torch.tensor(
        math.pi / 2 - alpha, dtype=torch.float64
    )  # of the small side x = 0, area 0.2 m^2
    side = 500.0 * 0.2
    c_d_side = hydro.drag_coefficient(alpha_edge).item()
    c_t_side = hydro.thrust_coefficient(alpha_edge).item()
    expected = 2000.0 * (c_d * water + torch.tensor([0.0, 0.0, -c_t]))
    expected = expected + side * (c_d_side * water + torch.tensor([c_t_side, 0.0, 0.0]))
    torch.testing.assert_close(total.sum(0), expected.double())
    assert total[top].abs().sum() > 0


@pytest.mark.reference
def test_terminal_velocity():
    """A block falling flat side down: drag and thrust on the bottom = weight - buoyancy.

    Stiff enough to stay a block to 1e-4; started at 0.8 of the answer, it has 6 time constants.
    """
    m = mesh.hex_box((2, 2, 1), (0.2, 0.2, 0.05))
    drag, thrust = (0.0, 0.0, 0.6, 1.1), (0.0, 0.0, 0.0, 0.4)  # nothing on faces seen edge-on
    hydro = soft.Hydrodynamics(m, drag_coefficients=drag, thrust_coefficients=thrust)
    gravity = (0.0, 0.0, -9.81)
    body = soft.SoftBody(
        m,
        dt=0.01,
        youngs_modulus=1e7,
        poissons_ratio=0.3,
        density=1500.0,
        gravity=gravity,
        masses=soft.Masses(added_mass=soft.added_mass(hydro, 0.5)),
    )
    expected = math.sqrt(2 * 500.0 * 0.002 * 9.81 / (1000.0 * 0.04 * (1.1 + 0.4)))
    lift = soft.buoyancy(m, 1000.0, gravity)
    state = body.rest_state()
    v = state.v.clone()
    v[:, 2] = -0.8 * expected
    with torch.no_grad():
        motion = soft.rollout(
            body,
            soft.State(state.x, v),
            120,
            external_force=lambda k, s: hydro(s.x, s.v) + lift,
        )
    assert motion.v[-1, :, 2].mean().item() == pytest.approx(-expected, rel=1e-3)
    assert motion.v[20, :, 2].mean().item() != pytest.approx(-expected, rel=1e-2)  # it took time


# gradients


@pytest.mark.grad
@pytest.mark.parametrize("kind", ["hex", "tet"])
@pytest.mark.parametrize("limit", [None, "isotropic", "component", "fade"])
def test_gradients(kind, limit):
    m, x, v = case(kind)
    options = {"max_force": 0.4, "limit": limit, "warn": False}
    if limit in (None, "fade"):
        options = {"fade_angle": 0.9 if limit else 0.0}

    def force(x, v, water, density, drag, thrust):
        hydro = soft.Hydrodynamics(
            m, density=density, drag_coefficients=drag, thrust_coefficients=thrust, **options
        )
        return hydro(x, v, water_velocity=water)

    args = (leaf(x), leaf(v), leaf([0.2, 0.5, -0.3]), leaf(1.3),
            leaf([0.1, 0.2, 1.1, 1.7]), leaf([-0.5, -0.2, 0.4, 1.9]))  # fmt: skip
    out = force(*args)
    grads = torch.autograd.grad(out, args, torch.linspace(1, 2, out.numel()).double().view_as(out))
    assert all(g.abs().max() > 0 for g in grads)
    assert torch.autograd.gradcheck(force, args, check_forward_ad=limit != "component")
    if "limit" in options:
        limited = out.detach().norm(dim=-1) > 0.4 * (1 - 1e-12)
        assert 0 < limited.sum() < limited.numel()  # limited and free nodes both checked


@pytest.mark.grad
def test_nothing_moves_nothing_acts():
    """At v_rel = 0 the force, which is of second order in v, and its gradient are exactly zero."""
    m, x, _ = case("hex")
    x, v = leaf(x), leaf(torch.zeros_like(x))
    hydro = soft.Hydrodynamics(m, max_force=1.0)
    forces = hydro(x, v)
    assert (forces == 0).all()
    for g in torch.autograd.grad(forces.sum(), (x, v, *hydro.parameters())):
        assert (g == 0).all()


@pytest.mark.grad
def test_kink_at_head_on_flow():
    """alpha = pi/2 has a kink; the gradient there is the mean of both sides, as a central
    difference is."""
    m = plate("hex")
    # these curves and their slopes vanish at alpha = 0, so that the side faces do not disturb
    hydro = soft.Hydrodynamics(
        m, drag_coefficients=(0.0, 0.0, 1.85, 2.05), thrust_coefficients=(1.0, 0.0, -1.0, 2.0)
    )

    def pull(u):
        water = torch.stack([u, torch.zeros_like(u), -torch.ones_like(u)])
        force = hydro(m.x_rest, torch.zeros_like(m.x_rest), water_velocity=water).sum(0)
        return force @ torch.tensor([1.0, 0.0, 2.0], dtype=torch.float64)

    u = leaf(0.0)
    (slope,) = torch.autograd.grad(pull(u), u)
    h = torch.tensor(1e-6, dtype=torch.float64)
    left = (pull(0 * h) - pull(-h)) / h
    right = (pull(h) - pull(0 * h)) / h
    assert (left - right).abs() > 1e4  # there is a kink
    # differences err by h times the curvature, some 1e4 * 1e-6
    assert slope.item() == pytest.approx(((left + right) / 2).item(), abs=0.05)
    assert slope.abs() > 1e3


@pytest.mark.property
@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_a_member_feels_what_it_feels_alone(kind):
    """Bits depend neither on who else is in a batch nor on the order."""
    m, x, v = case(kind, batch=(3,))
    hydro = soft.Hydrodynamics(m, fade_angle=0.2)
    many = [leaf(x), leaf(v)]
    forces = hydro(*many)
    weights = noise(*x.shape, seed=5)
    grads = torch.autograd.grad(forces, many, weights)
    for k in (2, 0, 1):
        one = [leaf(x[k]), leaf(v[k])]
        alone = hydro(*one)
        assert torch.equal(alone, forces[k])
        for mine, all_ in zip(torch.autograd.grad(alone, one, weights[k]), grads, strict=True):
            assert torch.equal(mine, all_[k])


@pytest.mark.property
def test_angles_of_attack_are_exact():
    """Kernels compute their own arctangent: a curve that is the angle shows its error."""
    m = plate("hex")
    line = (0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0)  # C_d = 2 alpha / pi
    hydro = soft.Hydrodynamics(
        m, density=2.0, drag_coefficients=line, thrust_coefficients=(0.0, 0.0, 0.0, 0.0)
    )
    still = torch.zeros_like(m.x_rest)
    for angle in torch.linspace(1e-3, math.pi / 2 - 1e-3, 57, dtype=torch.float64).tolist():
        way = torch.tensor([math.cos(angle), 0.0, math.sin(angle)], dtype=torch.float64)
        share = 2.0 * angle / math.pi
        # the plate of 4 m^2, and its rim of 0.2 m^2 that faces the flow along x
        expected = (4.0 * share + 0.2 * (1.0 - share)) * way
        force = hydro(m.x_rest, still, water_velocity=way).sum(0)
        torch.testing.assert_close(force, expected, rtol=1e-14, atol=1e-14)


@pytest.mark.property
def test_force_jumps_where_a_face_turns_edge_on():
    """Documented: C_d(0) and C_t(0) of the default curves are not zero."""
    m = plate("hex")
    hydro = soft.Hydrodynamics(m)
    rest = torch.zeros_like(m.x_rest)

    def lift(w):
        return hydro(m.x_rest, rest, water_velocity=torch.tensor([1.0, 0, w]).double()).sum(0)[2]

    jump = lift(-1e-9) - lift(1e-9)  # top face against bottom face, C_t(0) = 1/16
    assert jump.item() == pytest.approx(-2 * 0.5 * 1000.0 * 4.0 / 16, rel=1e-6)


@pytest.mark.property
def test_force_fades_where_a_face_turns_edge_on_if_asked():
    m = plate("hex")
    published, faded = (soft.Hydrodynamics(m, fade_angle=a) for a in (0.0, 0.1))
    x = m.x_rest

    def lift(hydro, angle):
        way = torch.tensor([math.cos(angle), 0.0, -math.sin(angle)], dtype=torch.float64)
        return hydro(x, way.expand(x.shape))[:, 2].sum()

    assert torch.equal(lift(faded, 0.11), lift(published, 0.11))
    jump = abs(lift(published, 1e-6) - lift(published, -1e-6))
    assert abs(lift(faded, 1e-6) - lift(faded, -1e-6)) < 1e-4 * jump
    angle = torch.tensor(0.05, dtype=torch.float64, requires_grad=True)
    way = torch.stack([angle.cos(), torch.zeros_like(angle), -angle.sin()])
    (slope,) = torch.autograd.grad(faded(x, way.expand(x.shape))[:, 2].sum(), angle)
    difference = (lift(faded, 0.05 + 1e-6) - lift(faded, 0.05 - 1e-6)) / 2e-6
    assert abs(slope - difference) < 1e-6 * abs(difference)
    with pytest.raises(ValueError, match="fade_angle"):
        soft.Hydrodynamics(m, fade_angle=-0.1)


@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_turns_with_the_body_and_scales_with_speed_squared(kind):
    m, x, v = case(kind)
    hydro = soft.Hydrodynamics(m, max_force=300.0, warn=False)
    forces, limited = hydro.evaluate(x, v)
    assert 0 < limited.sum() < m.num_nodes
    turn = torch.linalg.qr(noise(3, 3, seed=4))[0]
    turn = turn * turn.det()
    rotated = hydro.evaluate(x @ turn.T, v @ turn.T)
    torch.testing.assert_close(rotated.forces, forces @ turn.T, rtol=1e-10, atol=1e-9)
    assert (rotated.limited == limited).all()
    free = soft.Hydrodynamics(m)
    torch.testing.assert_close(free(x, 3 * v), 9 * free(x, v))
    drift = torch.tensor([0.3, -0.1, 0.2], dtype=torch.float64)  # only the difference counts
    torch.testing.assert_close(free(x, v + drift, water_velocity=drift), free(x, v))


def test_faces_of_other_nodes_are_refused():
    m, x, v = case("hex")
    hydro = soft.Hydrodynamics(m)
    faces = hydro.faces
    hydro.faces = faces + 1
    with pytest.raises(ValueError, match="indices of nodes"):
        hydro(x, v)
    hydro.faces = faces.int()
    with pytest.raises(TypeError, match="int64"):
        hydro(x, v)


def test_compiles_whole():
    m, x, v = case("tet")
    hydro = soft.Hydrodynamics(m, max_force=100.0, warn=False)
    whole = torch.compile(hydro, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(whole(x, v), hydro(x, v))


# the limit


@pytest.mark.parametrize("limit", ["isotropic", "component"])
def test_limit_says_when_it_acts(limit):
    m, x, v = case("hex")
    free = soft.Hydrodynamics(m)(x, v).detach()
    size = free.norm(dim=-1) if limit == "isotropic" else free.abs().amax(-1)
    bound = float(size.sort().values[-3:-1].mean())  # between the second and third largest
    hydro = soft.Hydrodynamics(m, max_force=bound, limit=limit)
    with pytest.warns(RuntimeWarning, match=rf"on 2 of {m.num_nodes} nodes.*largest would be"):
        forces, limited = hydro.evaluate(x, v)
    assert (limited == (size > bound)).all()
    torch.testing.assert_close(forces[~limited], free[~limited], rtol=0, atol=0)
    if limit == "isotropic":
        torch.testing.assert_close(forces[limited].norm(dim=-1), torch.full((2,), bound).double())
        direction = torch.nn.functional.cosine_similarity(forces[limited], free[limited])
        torch.testing.assert_close(direction, torch.ones(2).double())
    else:
        torch.testing.assert_close(forces, free.clamp(-bound, bound), rtol=0, atol=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hydro(x, v)  # said once
        soft.Hydrodynamics(m, max_force=bound, limit=limit, warn=False)(x, v)
        soft.Hydrodynamics(m, max_force=2 * float(size.max()), limit=limit)(x, v)


# the module


def test_numbers_become_parameters_and_tensors_stay():
    m = plate("hex")
    hydro = soft.Hydrodynamics(m)
    assert {n for n, _ in hydro.named_parameters()} == {"drag_coefficients", "thrust_coefficients"}
    given = leaf([0.0, 0.1, 0.2, 0.3])
    assert soft.Hydrodynamics(m, drag_coefficients=given).drag_coefficients is given
    twin = copy.deepcopy(hydro)
    twin.load_state_dict(hydro.state_dict())
    v = noise(m.num_nodes, 3)
    torch.testing.assert_close(twin(m.x_rest, v), hydro(m.x_rest, v), rtol=0, atol=0)
    assert "24 faces" not in repr(hydro) and "16 faces" in repr(hydro)


def test_water_velocity_per_call_and_batch():
    m, x, v = case("hex", batch=(3,))
    water = noise(3, 3, seed=5)
    hydro = soft.Hydrodynamics(m, water_velocity=water[1])
    out = hydro(x, v, water_velocity=water)
    torch.testing.assert_close(out[1], hydro(x[1], v[1]))
    assert (out[0] - hydro(x[0], v[0])).abs().max() > 1.0
    with pytest.raises(ValueError, match=r"water_velocity must broadcast to \(3, 3\), got \(2,"):
        hydro(x, v, water_velocity=water[:2])


# buoyancy and added mass


def test_buoyancy_is_the_weight_of_the_displaced_water():
    m = irregular_mesh("tet")
    lift = soft.buoyancy(m, 1000.0, (0.0, 1.0, -9.81))
    weight = mesh.total_volume(m) * 1000.0
    torch.testing.assert_close(lift.sum(0), weight * torch.tensor([0.0, -1.0, 9.81]).double())
    torch.testing.assert_close(soft.buoyancy(mesh.nodal_volume(m)).sum(0)[2], lift.sum(0)[2])
    body = soft_body(m, density=1000.0, gravity=(0.0, 1.0, -9.81), youngs_modulus=1e6)
    after = body(body.rest_state(), external_force=lift)  # neutrally buoyant: nothing moves
    torch.testing.assert_close(after.x, m.x_rest, rtol=0, atol=1e-10)
    with pytest.raises(TypeError, match=r"volume must be a HexMesh or a TetMesh.*got str"):
        soft.buoyancy("mesh")


@pytest.mark.reference
def test_added_mass_slows_a_beam_by_the_predicted_ratio():
    """Frequency of the first bending mode against that in vacuum: sqrt(rho / (rho + c rho_w)).

    Implicit midpoint turns the phase of a mode w by 2 atan(w dt / 2) a step, which is undone here;
    the finite amplitude and the second mode at the tip leave some 1e-4.
    """
    m = mesh.hex_box((8, 1, 1), (0.2, 0.02, 0.02))

    def frequency(added):
        body = soft.SoftBody(
            m,
            dt=1.5e-3,
            youngs_modulus=1.5e7,
            poissons_ratio=0.3,
            density=1200.0,
            gravity=(0.0, 0.0, 0.0),
            integrator="implicit_midpoint",
            fixed=m.nodes_near_plane("x", 0.0),
            masses=soft.Masses(added_mass=added),
        )
        tip = m.nodes_near_plane("x", 0.2)
        shape = (m.x_rest[:, :1] / 0.2) ** 2 * torch.tensor([0.0, 0.0, 0.01])
        with torch.no_grad():
            motion = soft.rollout(
                body, soft.State(m.x_rest, shape), 400, keep=lambda s: s.x[tip, 2].mean()
            )
        z = motion.x - motion.x[0]
        up = torch.nonzero((z[:-1] < 0) & (z[1:] >= 0))[:, 0]
        t = up + z[up] / (z[up] - z[up + 1])
        period = float((t[-1] - t[0]) / (len(t) - 1))  # in steps
        return 2.0 / 1.5e-3 * math.tan(math.pi / period), len(t)

    dry, _ = frequency(None)
    wet, count = frequency(soft.added_mass(m, 1.1, 1000.0))
    assert count >= 3
    assert wet / dry == pytest.approx(math.sqrt(1200.0 / (1200.0 + 1.1 * 1000.0)), rel=5e-4)


@pytest.mark.property
@pytest.mark.parametrize("integrator", ["implicit_euler", "semi_implicit_euler"])
def test_added_mass_is_inert_but_does_not_weigh(integrator):
    m = irregular_mesh("hex")
    body = soft_body(m, integrator=integrator, gravity=(0.0, 0.0, -10.0), dt=0.01)
    physics = body.physics(added_mass=3.0 * body.physics().mass)
    torch.testing.assert_close(physics.weighing_mass, body.physics().mass, rtol=0, atol=0)
    after = body(body.rest_state(), physics=physics)
    fall = torch.tensor([0.0, 0.0, -0.01 * 10.0 / 4.0]).double()
    torch.testing.assert_close(after.v, fall.expand_as(after.v), rtol=1e-9, atol=1e-9)


def test_static_equilibrium_does_not_feel_added_mass():
    m = irregular_mesh("hex")
    fixed = torch.tensor([0, 1, 2, 3])
    plain = soft_body(m, fixed=fixed)
    laden = soft_body(m, fixed=fixed, added_mass=soft.added_mass(m, 2.0, 5.0))
    torch.testing.assert_close(laden.static_equilibrium().x, plain.static_equilibrium().x)


def test_bad_added_mass():
    m = plate("hex")
    with pytest.raises(ValueError, match="density must be given with a mesh"):
        soft.added_mass(m, 1.0)
    with pytest.raises(ValueError, match=r"coefficient must lie in \[0, inf"):
        soft.added_mass(m, -1.0, 1000.0)
    with pytest.raises(ValueError, match=r"coefficient must have shape \(18\), got \(2"):
        soft.added_mass(m, (1.0, 2.0), 1000.0)
    with pytest.raises(ValueError, match=r"added_mass must lie in \[0, inf\), got -1; unit is kg"):
        soft_body(m, added_mass=-torch.ones(18, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"added_mass must have shape \(18\), got \(3"):
        soft_body(m).physics(added_mass=[1.0, 2.0, 3.0])
    assert float(soft.added_mass(soft.Hydrodynamics(m, density=900.0), 0.5).sum()) == pytest.approx(
        0.5 * 900.0 * 0.4
    )
