"""Numbers of any size: the right answer, or an error that says what is wrong, never another one."""

import math

import pytest
import torch
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from diffsim import contact, linalg, mesh, soft, stokes
from diffsim.core.errors import DiffsimError
from diffsim.mesh import sdf
from diffsim.stokes import shapes

pytestmark = [pytest.mark.property, pytest.mark.filterwarnings("ignore")]
BOUNDED = settings(
    max_examples=40, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
REFUSED = (ValueError, DiffsimError)
EXPONENT = st.integers(-320, 308)
UNIT = st.integers(-100, 100)


def landed(length: float, time: float, mass: float, friction: float | None) -> Tensor:
    """Two steps of a falling, turning box in other units; in the first ones again.

    Args:
        length, time, mass: The unit of the new numbers, in the old ones.
        friction: Of a floor that it lands on; None: free flight.
    """
    box = mesh.hex_box((2, 2, 1), (length, length, 0.5 * length))
    body = soft.SoftBody(
        box,
        dt=0.1 * time,
        youngs_modulus=100.0 * mass / (length * time**2),
        poissons_ratio=0.3,
        density=1.5 * mass / length**3,
        gravity=(0.0, 0.0, -1.0 * length / time**2),
        solver=soft.SolverOptions(rtol=1e-9),
    )
    turn = torch.tensor([0.3, 0.2, 1.0], dtype=torch.float64).expand_as(box.x_rest)
    v = torch.tensor([0.1, 0.0, -0.5], dtype=torch.float64) * (length / time)
    v = v + torch.linalg.cross(turn, box.x_rest) / time
    floor = None if friction is None else contact.floor(-0.02 * length, friction=friction)
    return soft.rollout(body, soft.State(box.x_rest, v), 2, obstacles=floor).final.x / length


def right_or_refused(work, expected: Tensor, tolerance: float) -> bool:
    """Whether work() had an answer, which must be the expected one."""
    try:
        found = work()
    except REFUSED as error:
        assert len(str(error)) > 20, error
        return False
    assert bool(found.isfinite().all()), found
    assert float((found - expected).abs().max()) < tolerance
    return True


@pytest.mark.parametrize("friction", [None, 0.0, 0.4, math.inf])
def test_common_units_do_not_matter(friction):
    expected = landed(1.0, 1.0, 1.0, friction)
    for units in ((1e3, 1.0, 1e3), (1.0, 1e-3, 1e6), (1e-6, 1e-3, 1e-9)):
        assert right_or_refused(lambda units=units: landed(*units, friction), expected, 1e-6)


@BOUNDED
@given(length=UNIT, time=UNIT, mass=EXPONENT, touches=st.booleans())
@example(length=-98, time=0, mass=0, touches=False)
@example(length=-60, time=-60, mass=-180, touches=True)
@example(length=0, time=0, mass=-308, touches=False)
@example(length=20, time=0, mass=0, touches=True)
@example(length=100, time=100, mass=0, touches=False)
def test_extreme_units_are_right_or_refused(length, time, mass, touches):
    friction = 0.4 if touches else None
    expected = landed(1.0, 1.0, 1.0, friction)
    units = [float(f"1e{k}") for k in (length, time, mass)]
    # E, density, speed and gravity in these units must be numbers themselves.
    powers = (mass - length - 2 * time, mass - 3 * length, length - time, length - 2 * time)
    assume(all(-300 < power < 300 for power in powers))
    right_or_refused(lambda: landed(*units, friction), expected, 1e-5)


@BOUNDED
@given(speed=st.integers(0, 308), touches=st.booleans())
@example(speed=20, touches=False)
@example(speed=20, touches=True)
def test_any_speed_ends_where_it_must(speed, touches):
    """A box thrown up: it is where its velocity brings it, up to rounding, or refused."""
    box = mesh.hex_box((2, 1, 1), (1.0, 0.5, 0.5))
    body = soft.SoftBody(box, dt=1.0, youngs_modulus=1e4, poissons_ratio=0.3, gravity=(0.0,) * 3)
    up = float(f"1e{speed}")
    v = torch.zeros_like(box.x_rest)
    v[:, 2] = up
    floor = contact.floor(-1.0) if touches else None

    def thrown() -> Tensor:
        return body(soft.State(box.x_rest, v), obstacles=floor).x / up

    right_or_refused(thrown, (box.x_rest + v) / up, 1e-6)


@BOUNDED
@given(exponent=EXPONENT, uneven=st.integers(-150, 150))
@example(exponent=-308, uneven=0)
@example(exponent=-160, uneven=0)
@example(exponent=0, uneven=-150)
def test_matrices_of_any_size(exponent, uneven):
    """A chain of springs, all as stiff as 10^exponent, the second half times 10^uneven."""
    n, scale = 6, float(f"1e{exponent}")
    stiffness = torch.ones(n + 1, dtype=torch.float64)
    stiffness[n // 2 :] = float(f"1e{uneven}")
    dense = torch.diag(stiffness[:-1] + stiffness[1:])
    dense -= torch.diag(stiffness[1:-1], 1) + torch.diag(stiffness[1:-1], -1)
    dense = dense * scale
    exact = torch.linspace(1.0, 2.0, n, dtype=torch.float64)
    right = dense @ exact
    if not (dense.isfinite().all() and right.isfinite().all()):
        return

    def residual() -> Tensor:
        x = linalg.SparseCholesky(dense.to_sparse_csr()).solve(right)
        return (dense / scale @ x - right / scale) / (right / scale).abs().max()

    right_or_refused(residual, torch.zeros(n, dtype=torch.float64), 1e-6)


@BOUNDED
@given(exponent=EXPONENT)
@example(exponent=-160)
@example(exponent=-310)
@example(exponent=-320)
@example(exponent=300)
def test_a_level_set_of_any_size_is_the_same_wall(exponent):
    grid = stokes.Grid((10, 10), size=1.0)
    flow = stokes.StokesFlow(grid, [stokes.Inlet("x-"), stokes.Open("x+")], wall="no_slip")
    away = (grid.nodes[..., 1] - 0.52).abs()
    inflow = torch.tensor([1.0, 0.0], dtype=torch.float64)

    def velocity(scale: float) -> Tensor:
        return flow((0.31 - away) * scale, inlet=inflow).velocity

    right_or_refused(lambda: velocity(float(f"1e{exponent}")), velocity(1.0), 1e-8)


def row(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


POINTS = torch.stack(
    [row(2.0, 0.3, 0.1), row(0.0, 3.0, 1.0), row(0.2, 0.1, 0.3), row(0.01, 0.02, -0.03)]
)
CURB = torch.sin(torch.arange(20.0, dtype=torch.float64)).reshape(4, 5)


def of_mesh(s: float) -> contact.MeshShape:
    box = mesh.hex_box((2, 2, 1), (1.0, 0.5, 0.7))
    return contact.MeshShape(mesh.HexMesh(s * box.x_rest, box.hexes))


SOLIDS = {
    "ball": contact.Sphere,
    "hollow": lambda s: contact.Sphere(s, inside_out=True),
    "capsule": lambda s: contact.Capsule((0.0, 0.0, 0.0), (0.0, 0.0, s), 0.5 * s),
    "box": lambda s: contact.Box((s, 2.0 * s, 0.5 * s)),
    "trough": lambda s: contact.Trough(s, 2.0),
    "half_space": lambda s: contact.Plane((1.0, 2.0, 3.0), 0.3 * s),
    "terrain": lambda s: contact.HeightField(0.1 * s * CURB, 0.5 * s, (-s, -s, 0.0)),
    "mesh": of_mesh,
    "stokes_ball": shapes.Sphere,
    "stokes_box": lambda s: shapes.Box((s, 2.0 * s, 0.5 * s)),
    "stokes_seam": lambda s: shapes.SmoothUnion(
        shapes.Sphere(s), shapes.Box((s, 2.0 * s, 3.0 * s)), radius=0.3 * s
    ),
    "sdf_ball": sdf.sphere,
    "sdf_box": lambda s: sdf.box((s, 2.0 * s, 0.5 * s)),
    "sdf_cylinder": lambda s: sdf.cylinder(s, 2.0 * s),
    "sdf_capsule": lambda s: sdf.capsule((0.0, 0.0, 0.0), (0.0, 0.0, s), 0.5 * s),
    "sdf_torus": lambda s: sdf.torus(s, 0.3 * s),
    "sdf_ellipsoid": lambda s: sdf.ellipsoid((s, 2.0 * s, 0.7 * s)),
    "sdf_shell": lambda s: sdf.shell(sdf.sphere(s), 0.1 * s),
    "sdf_seam": lambda s: sdf.smooth_union(sdf.sphere(s), sdf.box((s, 2.0 * s, 3.0 * s)), 0.3 * s),
}
"""Solids by name, with all of their lengths times s."""
TURNED = {
    "half_space": lambda s: contact.Plane((s, 2.0 * s, 3.0 * s), 0.3),
    "trough_axis": lambda s: contact.Trough(1.0, 2.0, axis=(0.0, s, 0.0)),
    "trough_start": lambda s: contact.Trough(1.0, 2.0, start=(0.0, 0.0, -s)),
    "stokes_plane": lambda s: shapes.Plane((s, 2.0 * s, 3.0 * s), 0.3),
    "stokes_turned": lambda s: shapes.Rotate(
        shapes.Box((1.0, 2.0, 3.0)), 0.3, axis=(s, 2.0 * s, 3.0 * s)
    ),
    "sdf_plane": lambda s: sdf.plane((s, 2.0 * s, 3.0 * s), 0.3),
    "sdf_turned": lambda s: sdf.rotate(sdf.box((1.0, 2.0, 3.0)), (s, 2.0 * s, 3.0 * s), 0.3),
}
"""Solids by name, with a direction of length s."""
SCALES = (
    -320,
    -300,
    -200,
    -160,
    -155,
    -150,
    -140,
    -131,
    -129,
    -60,
    60,
    69,
    100,
    149,
    155,
    160,
    300,
)


@pytest.mark.parametrize("name", SOLIDS)
def test_a_solid_of_any_size_is_the_same_solid(name):
    """At 1e-160 m a ball was around all points: its distances were of one sign."""
    make = SOLIDS[name]
    expected = make(1.0)(POINTS)
    sizes = [float(f"1e{k}") for k in SCALES]
    told = [
        right_or_refused(lambda s=s: make(s)(s * POINTS) / s, expected, 1e-6)
        for s in (sizes if name != "half_space" else sizes[1:])  # of 1e-320 a third is rounded
    ]
    assert told[sizes.index(1e60) - len(sizes)], "what is a number must be computed"


@pytest.mark.parametrize("name", TURNED)
def test_a_direction_of_any_length_is_the_same_direction(name):
    make = TURNED[name]
    expected = make(1.0)(POINTS)
    told = [
        right_or_refused(lambda k=k: make(float(f"1e{k}"))(POINTS), expected, 1e-9) for k in SCALES
    ]
    assert any(told)
