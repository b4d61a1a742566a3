"""Pneumatic chambers: volumes, forces, gradients, and the thick-walled sphere of Lame."""

import math

import numpy as np
import pytest
import torch

from diffsim import mesh, soft
from diffsim.core.errors import ConvergenceError
from tests.gradients import check_directions
from tests.helpers import at_rest
from tests.soft.cases import deformed, leaf, noise, rail_mask, soft_body

# The differences of gradcheck are over 2e-6; the solver stops at 1e-12 of the force scale.
TOLERANCE = {"eps": 1e-6, "atol": 2e-5, "rtol": 2e-5}
SHAPES = ["cavity", "pocket", "tunnel"]


def hollow(kind="hex", shape="cavity", amount=0.06):
    """A 3 m cube of 27 cells without its middle cell (cavity), open to the top (pocket) or to both
    sides (tunnel), all nodes displaced; and the chamber inside."""
    cells = (3, 3, 3)
    box = (mesh.hex_box if kind == "hex" else mesh.tet_box)(cells, (3.0, 3.0, 3.0))
    center = box.x_rest[box.elements].mean(1)
    inside = ((center - 1.5).abs()[:, :2] < 0.5).all(1)
    if shape != "tunnel":
        inside &= center[:, 2] > 1.0
    if shape == "cavity":
        inside &= center[:, 2] < 2.0
    x = box.x_rest + amount * noise(box.num_nodes, 3, seed=9).clamp(-1.5, 1.5)
    m = type(box)(x, box.elements[~inside])
    if shape == "cavity":
        return m, soft.PressureChamber.from_cavity(m)
    # The triangles that were faces of the removed cells: all nodes within the middle column.
    faces = mesh.surface_triangles(m).faces
    at = box.x_rest[faces]
    wall = ((at[..., :2] - 1.5).abs() < 0.6).all(-1).all(-1)
    wall &= ~((at[..., 2] == 0.0).all(-1) | (at[..., 2] == 3.0).all(-1))
    return m, soft.PressureChamber(faces[wall])


def shell(num: int, inner: float, outer: float):
    """A thick-walled sphere of hexahedra: the quads of a cube's surface on spheres, num an even
    number of quads per cube edge, num / 2 layers."""
    box = mesh.hex_box((num,) * 3, (2.0,) * 3, (-1.0,) * 3)
    skin, quads = torch.unique(mesh.surface_quads(box).faces, return_inverse=True)
    angle = torch.tan(box.x_rest[skin] * math.pi / 4)  # equal angles on each cube edge
    unit = angle / angle.norm(dim=1, keepdim=True)
    radii = torch.linspace(inner, outer, num // 2 + 1, dtype=torch.float64)
    x = torch.cat([r * unit for r in radii])
    order = [0, 3, 1, 2]  # i outwards: (dj, dk) = 00, 01, 10, 11 are corners a, d, b, c
    layers = [
        torch.cat([quads[:, order] + k * len(skin), quads[:, order] + (k + 1) * len(skin)], 1)
        for k in range(num // 2)
    ]
    return mesh.HexMesh(x, torch.cat(layers))


# --- cavities and volumes ---


@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_cavities_are_found_largest_first(kind):
    box = (mesh.hex_box if kind == "hex" else mesh.tet_box)((7, 3, 3), (7.0, 3.0, 3.0))
    center = box.x_rest[box.elements].mean(1)
    middle = ((center[:, 1:] - 1.5).abs() < 0.5).all(1)
    small = middle & (center[:, 0] > 1.0) & (center[:, 0] < 2.0)
    large = middle & (center[:, 0] > 3.0) & (center[:, 0] < 5.0)
    assert mesh.cavities(box) == []
    m = type(box)(box.x_rest, box.elements[~(small | large)])
    found = mesh.cavities(m)
    assert len(found) == 2
    volumes = [float(soft.PressureChamber(faces).volume(m.x_rest)) for faces in found]
    assert volumes == pytest.approx([2.0, 1.0], rel=1e-14)
    # Triangles of the boundary as they are, so normals point out of the solid.
    boundary = {tuple(f) for f in mesh.surface_triangles(m).faces.tolist()}
    assert all({tuple(f) for f in faces.tolist()} < boundary for faces in found)


def test_separate_bodies_bound_no_cavity():
    one = mesh.hex_box((1, 1, 1))
    two = mesh.HexMesh(
        torch.cat([one.x_rest, one.x_rest + 3.0]), torch.cat([one.elements, one.elements + 8])
    )
    assert mesh.cavities(two) == []


@pytest.mark.parametrize("kind", ["hex", "tet"])
@pytest.mark.parametrize("shape", SHAPES)
def test_volume_follows_an_affine_map(shape, kind):
    """V(F x) = det F V(x), lids included: every affine map takes a mean of nodes along."""
    m, chamber = hollow(kind, shape, amount=0.0)
    expected = {"cavity": 1.0, "pocket": 2.0, "tunnel": 3.0}[shape]
    assert len(chamber.lids) == {"cavity": 0, "pocket": 1, "tunnel": 2}[shape]
    assert chamber.is_closed == (shape == "cavity")
    torch.testing.assert_close(float(chamber.volume(m.x_rest)), expected, rtol=1e-14, atol=0.0)
    F = torch.eye(3, dtype=torch.float64) + 0.3 * noise(3, 3, seed=1)
    moved = m.x_rest @ F.T + noise(3, seed=2)
    expected *= float(torch.linalg.det(F))
    torch.testing.assert_close(float(chamber.volume(moved)), expected, rtol=1e-13, atol=0.0)
    batch = torch.stack([m.x_rest, moved])
    torch.testing.assert_close(
        chamber.volume(batch), torch.stack([chamber.volume(x) for x in batch]), rtol=0, atol=0
    )


# --- forces ---


@pytest.mark.parametrize("kind", ["hex", "tet"])
@pytest.mark.parametrize("shape", SHAPES)
def test_force_is_pressure_times_the_gradient_of_volume(shape, kind):
    m, chamber = hollow(kind, shape)
    body = soft_body(m, chambers=[chamber])
    x = leaf(deformed(m))
    volume = chamber.volume(x)
    (slope,) = torch.autograd.grad(volume, x)
    pressure = torch.tensor([7.0], dtype=torch.float64)
    force = body.elastic_force(x, pressure=pressure) - body.elastic_force(x)
    torch.testing.assert_close(force, 7.0 * slope, rtol=0, atol=1e-13)
    energy = body.elastic_energy(x, pressure=pressure) - body.elastic_energy(x)
    torch.testing.assert_close(energy, -7.0 * volume, rtol=1e-13, atol=0)
    # A closed surface neither pushes nor turns the body; lids hand what they feel to the rim.
    assert force.sum(0).norm() < 1e-13
    assert torch.linalg.cross(x, force).sum(0).norm() < 1e-12
    # Nodes away from the chamber feel nothing.
    away = torch.ones(m.num_nodes, dtype=torch.bool)
    away[chamber.faces.flatten()] = False
    assert away.any() and (force[away] == 0.0).all()


def test_positive_pressure_pushes_the_walls_apart():
    m, chamber = hollow("hex", "cavity", amount=0.0)
    body = soft_body(m, chambers=[chamber])
    pressure = torch.tensor([1.0], dtype=torch.float64)
    force = body.elastic_force(m.x_rest, pressure=pressure)
    nodes = chamber.faces.unique()
    assert ((force * (m.x_rest - 1.5))[nodes].sum(1) > 0.0).all()
    # Each wall of the unit cell carries p A = 1 N.
    wall = nodes[m.x_rest[nodes, 0] > 1.5]
    torch.testing.assert_close(float(force[wall, 0].sum()), 1.0, rtol=1e-13, atol=0.0)


@pytest.mark.parametrize("shape", ["cavity", "pocket"])
def test_far_from_the_origin_nothing_is_lost(shape):
    m, chamber = hollow("hex", shape)
    body = soft_body(m, chambers=[chamber])
    x, far = deformed(m), torch.full((3,), 2.0**20, dtype=torch.float64)
    pressure = torch.tensor([5.0], dtype=torch.float64)
    near, away = (body.elastic_force(y, pressure=pressure) for y in (x, x + far))
    # Positions lose 1e6 * 1e-16 m there; stiffnesses are about 100 N/m.
    torch.testing.assert_close(near, away, rtol=0, atol=1e-7)
    torch.testing.assert_close(chamber.volume(x), chamber.volume(x + far), rtol=1e-8, atol=0)


def test_no_pressure_is_no_chamber():
    m, chamber = hollow("tet", "pocket")
    with_chamber, without = soft_body(m, chambers=[chamber]), soft_body(m)
    x = deformed(m)
    for pressure in (None, torch.zeros(1, dtype=torch.float64)):
        a, b = with_chamber.elastic_force(x, pressure=pressure), without.elastic_force(x)
        torch.testing.assert_close(a, b, rtol=0, atol=0)


# --- gradients ---


@pytest.mark.grad
@pytest.mark.parametrize("shape", ["cavity", "pocket"])
def test_the_hessian_is_exact_and_symmetric(shape):
    """All of it, entry by entry: the pressure's own part, without the solid's."""
    m, chamber = hollow("hex", shape)
    body = soft_body(m, chambers=[chamber])
    x, one = leaf(deformed(m)), torch.ones(1, dtype=torch.float64)

    def product(direction):
        both = [body.elastic_force(x, pressure=p) for p in (one, 0.0 * one)]
        return [torch.autograd.grad(f, x, direction)[0] for f in both]

    nodes = chamber.faces.unique()[:6]
    H = torch.zeros(m.num_nodes, 3, 6, 3, dtype=torch.float64)
    for k, node in enumerate(nodes):
        for axis in range(3):
            direction = torch.zeros_like(x)
            direction[node, axis] = 1.0
            with_pressure, without = product(direction)
            H[:, :, k, axis] = with_pressure - without
    # V is cubic: central differences of its gradient are exact, whatever the step.
    for k, node in enumerate(nodes):
        for axis in range(3):
            step = torch.zeros_like(x)
            step[node, axis] = 0.5
            slopes = []
            for y in (x.detach() + step, x.detach() - step):
                y.requires_grad_()
                slopes.append(torch.autograd.grad(chamber.volume(y), y)[0])
            torch.testing.assert_close(H[:, :, k, axis], slopes[0] - slopes[1], rtol=0, atol=1e-12)
    block = H[nodes].reshape(18, 18)
    assert block.abs().max() > 0.1
    torch.testing.assert_close(block, block.T, rtol=0, atol=1e-13)


@pytest.mark.grad
@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_static_gradients(kind):
    """Two chambers that share walls: the tunnel's is cut into an upper and a lower pocket."""
    m, tunnel = hollow(kind, "tunnel", amount=0.0)
    upper = (m.x_rest[tunnel.faces][..., 2] > 0.99).all(1)
    chambers = [soft.PressureChamber(tunnel.faces[upper]), soft.PressureChamber(tunnel.faces)]
    body = soft_body(m, chambers=chambers, fixed=m.nodes_near_plane("x", 0.0))

    def layer(pressure, youngs_modulus):
        physics = body.physics(youngs_modulus=youngs_modulus)
        return body.static_equilibrium(pressure=pressure, physics=physics).x

    check_directions(layer, (leaf([3.0, -2.0]), leaf(30.0)), seeds=(0, 1), **TOLERANCE)


# --- against the closed form ---


def lame_error(m, inner, outer, pressure, method="auto"):
    """Relative error of the mean displacement of the inner surface (Timoshenko and Goodier,
    Theory of Elasticity, 1970, art. 136):

    u(r) = p a^3 r / (E (b^3 - a^3)) ((1 - 2 nu) + (1 + nu) b^3 / (2 r^3))
    """
    youngs_modulus, poissons_ratio = 1e6, 0.3
    chamber = soft.PressureChamber.from_cavity(m)
    # Symmetry planes hold the sphere without disturbing it.
    fixed = m.x_rest.abs() < 1e-9
    body = soft.SoftBody(
        m,
        dt=0.01,
        youngs_modulus=youngs_modulus,
        poissons_ratio=poissons_ratio,
        gravity=(0.0, 0.0, 0.0),
        chambers=[chamber],
        fixed=fixed,
        solver=soft.SolverOptions(method=method, rtol=1e-8),
    )
    x = body.static_equilibrium(pressure=torch.tensor([pressure], dtype=torch.float64)).x
    nodes = chamber.faces.unique()
    u = (x.norm(dim=1) - m.x_rest.norm(dim=1))[nodes].mean()
    a, b = inner**3, outer**3
    exact = (1.0 - 2.0 * poissons_ratio) + (1.0 + poissons_ratio) * b / (2.0 * a)
    exact *= pressure * a * inner / (youngs_modulus * (b - a))
    return float(u) / exact - 1.0


@pytest.mark.order
def test_thick_walled_sphere_converges_to_lame():
    """Pressure of 1e-5 E, so that what is left of nonlinearity is 1e-5."""
    nums = [8, 12, 16]
    errors = [abs(lame_error(shell(num, 1.0, 2.0), 1.0, 2.0, 10.0)) for num in nums]
    order = -np.polyfit(np.log(nums), np.log(errors), 1)[0]
    assert errors[-1] < 0.01
    assert order == pytest.approx(2.0, abs=0.1), errors


@pytest.mark.reference
def test_thick_walled_sphere_of_tetrahedra():
    """Linear tetrahedra are stiff: 9 % and 5 % too little at five and seven of them across, on the
    way of the second order: (4/3)^2 = 1.8."""
    solid = mesh.sdf.difference(mesh.sdf.sphere(2.0), mesh.sdf.sphere(1.0))
    coarse, fine = (mesh.tet_from_sdf(solid, ([-2.0] * 3, [2.0] * 3), h) for h in (0.4, 0.3))
    errors = [lame_error(m, 1.0, 2.0, 10.0) for m in (coarse, fine)]
    assert -0.06 < errors[1] < 0.0
    assert errors[0] / errors[1] > 1.6


# --- batches ---


@pytest.mark.parametrize("load", ["pressure", "external_force", "dirichlet_target", "activation"])
def test_static_batch_of_any_load(load):
    """Members of a load, whose guess is one, are what each gives alone."""
    m, chamber = hollow("hex", "cavity")
    every = torch.arange(m.num_elements)
    muscle = soft.Muscle(elements=every, direction=[1.0, 0.2, 0.1], stiffness=5.0)
    fixed = m.nodes_near_plane("x", 0.0, 0.3)
    body = soft_body(m, chambers=[chamber], fixed=fixed, muscles=[muscle])
    shape = {"pressure": (1,), "activation": (1,)}.get(load, (m.num_nodes, 3))
    many = torch.arange(3.0).double().reshape(3, *[1] * len(shape)) * noise(*shape)
    many = {"pressure": 2.0, "activation": 0.2, "external_force": 0.1}.get(load, 0.01) * many
    if load == "dirichlet_target":
        many = m.x_rest + many
    found = body.static_equilibrium(**{load: many})
    assert found.x.shape == (3, m.num_nodes, 3) and not found.v.any()
    assert (found.x[2] - found.x[0]).abs().max() > 1e-4
    for member, x in zip(many, found.x, strict=True):
        single = body.static_equilibrium(**{load: member}).x
        torch.testing.assert_close(x, single, rtol=0, atol=0)


# --- what happens at the limits ---


def test_a_pressure_beyond_what_the_material_holds_inflates_without_limit():
    """-p V is cubic in x, E quadratic: there is no minimum to find, and that is said."""
    m = shell(4, 1.0, 1.3)
    body = soft_body(
        m,
        gravity=(0.0, 0.0, 0.0),
        chambers=[soft.PressureChamber.from_cavity(m)],
        fixed=m.x_rest.abs() < 1e-9,
        solver=soft.SolverOptions(max_iters=50),
    )
    with pytest.raises(ConvergenceError, match="implicit step stopped after"):
        body.static_equilibrium(pressure=torch.tensor([4.0], dtype=torch.float64))


@pytest.mark.parametrize("pressure", [-3.0, -30.0])
def test_vacuum_is_solved_or_refused(pressure):
    m = shell(4, 1.0, 1.3)
    body = soft_body(m, chambers=[soft.PressureChamber.from_cavity(m)], dt=0.02, density=0.3)
    state = body.rest_state()
    before = float(body.chambers.volumes(state.x))
    for _ in range(5):
        state = body(state, pressure=torch.tensor([pressure], dtype=torch.float64))
    assert state.x.isfinite().all()
    assert float(body.chambers.volumes(state.x)) < before


def test_sealed_gas_keeps_its_amount():
    volume, amount = leaf([2.0, 4.0, 8.0]), 4.0 * 101325.0
    gauge = soft.sealed_pressure(volume, 4.0)
    torch.testing.assert_close(
        (gauge + 101325.0) * volume, torch.full_like(volume, amount), rtol=1e-14, atol=0
    )
    assert gauge[1].abs() < 1e-10 and gauge[0] > 0.0 > gauge[2]
    filled = soft.sealed_pressure(volume, 2.0, filled_pressure=5e3, ambient_pressure=1e5)
    torch.testing.assert_close(float(filled[0].detach()), 5e3, rtol=1e-12, atol=0.0)
    assert torch.autograd.gradcheck(
        lambda v, f: soft.sealed_pressure(v, f, ambient_pressure=3.0), (volume, leaf(4.0))
    )
    with pytest.raises(ValueError, match="volume must be positive, got -1; the chamber has turned"):
        soft.sealed_pressure(torch.tensor([-1.0]).double(), 1.0)


def test_rollout_on_sealed_gas():
    """A squeezed cavity springs back harder with gas in it, and the gradient goes through it."""
    m, chamber = hollow("hex", "cavity")
    body = soft_body(m, chambers=[chamber], gravity=(0.0, 0.0, 0.0))
    start = m.x_rest * torch.tensor([1.0, 1.0, 0.7], dtype=torch.float64)
    filled = chamber.volume(m.x_rest)

    def volume_after(ambient, checkpoint_every=None):
        def pressure(_, state):
            volumes = body.chambers.volumes(state.x)
            return soft.sealed_pressure(volumes, filled, ambient_pressure=ambient)

        x = leaf(start)
        end = soft.rollout(
            body, at_rest(x), 4, pressure=pressure, checkpoint_every=checkpoint_every
        )
        volume = chamber.volume(end.final.x)
        return float(volume.detach()), torch.autograd.grad(volume, x)[0]

    (empty, _), (full, grad) = volume_after(0.0), volume_after(10.0)
    assert full > empty > float(chamber.volume(start))
    again, grad_again = volume_after(10.0, checkpoint_every=2)
    assert again == full
    torch.testing.assert_close(grad_again, grad, rtol=1e-12, atol=1e-12)


# --- refusals ---

BOX = mesh.hex_box((3, 3, 3), (3.0, 3.0, 3.0))
FACES = mesh.surface_triangles(BOX).faces
BAD_CHAMBERS = [
    (FACES.double(), TypeError, "faces must be torch.int64, got torch.float64"),
    (FACES[:, :2], ValueError, r"faces must have shape \(num_faces, 3\), got"),
    (FACES[:0], ValueError, "faces must name at least one triangle"),
    (FACES[:, [0, 1, 1]], ValueError, r"three different nodes, got faces\[0\] = \("),
    (torch.cat([FACES, FACES[:1]]), ValueError, "along the edge .* in the same direction"),
    (torch.cat([FACES[:1], FACES[1:2, [0, 2, 1]]]), ValueError, "must be oriented alike"),
    (
        torch.tensor([[0, 1, 2], [0, 3, 4]]),
        ValueError,
        "the rim of faces must not cross itself, but it does at vertex 0",
    ),
]


@pytest.mark.parametrize(("faces", "error", "message"), BAD_CHAMBERS)
def test_bad_faces(faces, error, message):
    with pytest.raises(error, match=message):
        soft.PressureChamber(faces)


def test_bad_chambers_of_a_body():
    turned = FACES[:2, [0, 2, 1]]
    inner = torch.tensor([[21, 22, 26]])  # about the middle cell, which is solid
    beyond = torch.tensor([[0, 1, 64]])
    for chamber, message in (
        (turned, r"chambers\[1\].faces\[0\] = .* is turned into the solid: normals must point"),
        (inner, r"chambers\[1\].faces\[0\] = \(21, 22, 26\) is not a triangle of the mesh's"),
        (beyond, r"chambers\[1\].faces must hold indices of nodes in \[0, 64\), got 64"),
    ):
        good = soft.PressureChamber(FACES[:2])
        with pytest.raises(ValueError, match=message):
            soft_body(BOX, chambers=[good, soft.PressureChamber(chamber)])
    with pytest.raises(TypeError, match=r"chambers\[0\] must be a PressureChamber, got Tensor"):
        soft_body(BOX, chambers=[FACES])
    # Either diagonal of a quad will do.
    a, b, c, d = mesh.surface_quads(BOX).faces[0].tolist()
    soft_body(BOX, chambers=[soft.PressureChamber(torch.tensor([[a, b, d], [b, c, d]]))])


def test_bad_cavity_index():
    with pytest.raises(ValueError, match="one of the mesh's 0 cavities, got 0; an open pocket"):
        soft.PressureChamber.from_cavity(BOX)
    m, _ = hollow()
    with pytest.raises(ValueError, match="one of the mesh's 1 cavities, got -1"):
        soft.PressureChamber.from_cavity(m, -1)
    with pytest.raises(TypeError, match="index must be a whole number, got float"):
        soft.PressureChamber.from_cavity(m, 0.0)


def test_bad_pressures():
    m, chamber = hollow()
    body = soft_body(m, chambers=[chamber], fixed=rail_mask(m))
    one = torch.ones(1, dtype=torch.float64)
    for pressure, error, message in (
        (2.0, TypeError, r"pressure must be a torch.Tensor( or a Callable)?, got float"),
        (one.float(), TypeError, "pressure must be torch.float64"),
        (torch.ones(2).double(), ValueError, r"pressure must have shape \(\.\.\., 1\), got \(2,\)"),
        (torch.ones(4, 1).double(), ValueError, r"pressure must broadcast to \(1,\), got \(4, 1\)"),
        (one * math.nan, ValueError, "pressure must be finite"),
    ):
        for call in (
            lambda p: body(body.rest_state(), pressure=p),
            lambda p: body.elastic_force(m.x_rest, pressure=p),
            lambda p: soft.rollout(body, body.rest_state(), 1, pressure=p),
        ):
            with pytest.raises(error, match=message):
                call(pressure)
    with pytest.raises(ValueError, match="the body has no chambers"):
        soft_body(m)(soft_body(m).rest_state(), pressure=one)
