"""Does the error shrink as promised, in time and in mesh size, and towards the right answer?"""

import math
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest
import torch

from diffsim import mesh, soft
from tests.helpers import observed_order
from tests.soft.cases import irregular_mesh, soft_body

pytestmark = pytest.mark.order


def state_at(body_of, integrator, dt, time):
    """Final (x, v) with the step dt."""
    body = body_of(integrator=integrator, dt=dt)
    m = body.mesh
    # Smooth motion with fast and slow modes that starts in agreement with the Dirichlet set.
    free = 1.0 - body.fixed.double()
    x = m.x_rest + 0.05 * free * torch.sin(3.0 * m.x_rest[:, [1, 2, 0]])
    state = soft.State(x, 0.3 * free * torch.cos(2.0 * m.x_rest))
    for _ in range(round(time / dt)):
        state = body(state)
    return torch.cat([state.x, state.v])


TIME = 0.32
# (order, steps): the explicit method is unstable above about 0.03 s.
ORDERS = {
    "implicit_euler": (1, [0.005, 0.0025, 0.00125]),
    "semi_implicit_euler": (1, [0.005, 0.0025, 0.00125]),
    "bdf2": (2, [0.02, 0.01, 0.005]),
    "implicit_midpoint": (2, [0.02, 0.01, 0.005]),
}


def order_body(kind, **damping):
    def make(**options):
        m = irregular_mesh(kind, (2, 1, 1), (1.0, 0.5, 0.5), 0.02)
        return soft_body(
            m,
            youngs_modulus=4.0,
            density=2.0,
            poissons_ratio=0.2,
            fixed=torch.tensor([0, 1, 2, 3]),
            **damping,
            **options,
        )

    return make


@lru_cache
def nearly_exact(kind, **damping):
    """Midpoint with a step 8 times finer than the finest second-order one: its error is 1/64 of
    that."""
    return state_at(order_body(kind, **damping), "implicit_midpoint", TIME / 512, TIME)


@pytest.mark.parametrize("kind", ["hex", "tet"])
@pytest.mark.parametrize("integrator", ORDERS)
def test_order_in_time(integrator, kind):
    order, steps = ORDERS[integrator]
    make = order_body(kind, rayleigh_alpha=0.2)
    exact = nearly_exact(kind, rayleigh_alpha=0.2)
    error = [float((state_at(make, integrator, dt, TIME) - exact).norm()) for dt in steps]
    assert observed_order(steps, error) == pytest.approx(order, abs=0.1)
    assert error[-1] < 0.05


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2", "implicit_midpoint"])
def test_order_in_time_with_material_damping(integrator):
    """The damping frame is a second-order prediction, so the integrators keep their orders."""
    order, steps = ORDERS[integrator]
    make = order_body("hex", rayleigh_beta=0.1)
    exact = nearly_exact("hex", rayleigh_beta=0.1)
    error = [float((state_at(make, integrator, dt, TIME) - exact).norm()) for dt in steps]
    assert observed_order(steps, error) == pytest.approx(order, abs=0.15)


# --- mesh size: a cantilever of 1 m x 0.1 m x 0.1 m ---------------------------------------------

LENGTH, SIDE, YOUNG, DENSITY = 1.0, 0.1, 1e7, 1000.0
AREA, INERTIA = SIDE**2, SIDE**4 / 12.0
SMALL = 0.1  # gravity that turns the tip by 2e-3: linear to its square, far above rounding [m/s^2]


def cantilever(kind, n, nu, **changes):
    """n cells over the height, square cells; clamped at x = 0."""
    cells = (10 * n, n, n)
    m = (mesh.hex_box if kind == "hex" else mesh.tet_box)(cells, (LENGTH, SIDE, SIDE))
    options = {
        "youngs_modulus": YOUNG,
        "poissons_ratio": nu,
        "density": DENSITY,
        "dt": 1e-3,
        "gravity": (0.0, 0.0, -SMALL),
        "fixed": m.nodes_near_plane("x", 0.0),
        "solver": soft.SolverOptions(rtol=1e-7),
    }
    return soft_body(m, **{**options, **changes})


def timoshenko_sag(nu):
    """Tip deflection per gravity of a beam under its own weight, with shear."""
    load = DENSITY * AREA
    shear_modulus = YOUNG / (2.0 * (1.0 + nu))
    shear_factor = 10.0 * (1.0 + nu) / (12.0 + 11.0 * nu)  # Cowper 1966, rectangle
    bending = load * LENGTH**4 / (8.0 * YOUNG * INERTIA)
    return bending + load * LENGTH**2 / (2.0 * shear_factor * shear_modulus * AREA)


def sag(kind, n, nu):
    body = cantilever(kind, n, nu)
    tip = body.mesh.nodes_near_plane("x", LENGTH)
    drop = body.x_rest[tip, 2] - body.static_equilibrium().x[tip, 2]
    return float(drop.mean()) / SMALL


@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_cantilever_sag_converges(kind):
    """Displacement elements are too stiff; the error is second order in the cell size.

    nu = 0, where clamping the cross-section costs nothing: the beam formula then holds to
    O((d/L)^4) of its bending part. Full integration locks in shear: large errors, but orderly.
    """
    exact = timoshenko_sag(0.0)
    sizes = [1, 2, 4] if kind == "hex" else [2, 4]
    error = [1.0 - sag(kind, n, 0.0) / exact for n in sizes]
    assert all(e > 0 for e in error), "stiffer than the beam"
    assert all(b < 0.5 * a for a, b in pairwise(error))
    if kind == "hex":
        # err = c h^2 / (1 + c h^2) when elements lock: compare flexibilities' inverse.
        stiffness_error = [1.0 / (1.0 - e) - 1.0 for e in error]
        assert observed_order([1, 1 / 2, 1 / 4], stiffness_error) == pytest.approx(2.0, abs=0.1)
        assert error[-1] < 0.06


def test_cantilever_sag_at_nu_03():
    """Two meshes extrapolated to h = 0 in stiffness; the clamp's warping restraint is worth about
    1 %."""
    one, two = (1.0 / sag("hex", n, 0.3) for n in (2, 4))
    extrapolated = 1.0 / ((4.0 * two - one) / 3.0)
    assert extrapolated == pytest.approx(timoshenko_sag(0.3), rel=0.015)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_cantilever_sag_on_fine_meshes(kind):
    error = [1.0 - sag(kind, n, 0.0) / timoshenko_sag(0.0) for n in (4, 8)]
    stiffness_error = [1.0 / (1.0 - e) - 1.0 for e in error]
    assert observed_order([1 / 4, 1 / 8], stiffness_error) == pytest.approx(2.0, abs=0.1)


def bending_mode(body):
    """The first bending mode of a cantilever, tip deflection 1e-4 m, as a state at rest."""
    x = body.x_rest
    k = 1.8751 / LENGTH
    s = x[:, 0] * k
    ratio = (math.cosh(1.8751) + math.cos(1.8751)) / (math.sinh(1.8751) + math.sin(1.8751))
    shape = torch.cosh(s) - torch.cos(s) - ratio * (torch.sinh(s) - torch.sin(s))
    slope = k * (torch.sinh(s) + torch.sin(s) - ratio * (torch.cosh(s) - torch.cos(s)))
    move = torch.zeros_like(x)
    move[:, 2] = shape
    move[:, 0] = -(x[:, 2] - SIDE / 2) * slope  # sections stay plane and normal
    move *= 1e-4 / float(shape.max())
    return soft.State(x + move, torch.zeros_like(x))


def ring(body, num_steps):
    """Tip deflection over time after release from the first bending mode [m]."""
    state = bending_mode(body)
    tip = body.mesh.nodes_near_plane("x", LENGTH)
    signal = [float((state.x - body.x_rest)[tip, 2].mean())]
    for _ in range(num_steps):
        state = body(state)
        signal.append(float((state.x - body.x_rest)[tip, 2].mean()))
    return np.array(signal)


def frequency_and_damping(signal, dt):
    """Angular frequency [rad/s] and damping ratio of a decaying cosine, by linear prediction.

    u[k+1] + u[k-1] r^2 = 2 r cos(w dt) u[k] holds for every damped sinusoid; a lag of several steps
    averages over faster modes' ripple.
    """
    lag = max(1, len(signal) // 12)
    a = np.stack([signal[lag:-lag], signal[: -2 * lag]], axis=1)
    c1, c2 = np.linalg.lstsq(a, signal[2 * lag :], rcond=None)[0]
    radius = math.sqrt(-c2)
    angle = math.acos(np.clip(c1 / (2 * radius), -1, 1)) / (lag * dt)
    decay = -math.log(radius) / (lag * dt)
    return math.hypot(angle, decay), decay / math.hypot(angle, decay)


def ringing(num_steps, dt, integrator, n=1, nu=0.3, rtol=1e-9, **damping):
    """Frequency [rad/s] and damping ratio of a beam let go from its first bending mode."""
    solver = soft.SolverOptions(rtol=rtol)
    still = {"gravity": (0.0, 0.0, 0.0), "dt": dt, "integrator": integrator, "solver": solver}
    return frequency_and_damping(ring(cantilever("hex", n, nu, **still, **damping), num_steps), dt)


BEAM_FREQUENCY = 1.8751**2 * math.sqrt(YOUNG * INERTIA / (DENSITY * AREA * LENGTH**4))


def test_first_bending_frequency_converges():
    """Euler-Bernoulli lowered by shear and rotary inertia (1 % here); elements are too stiff."""
    error = []
    for n in (1, 2):
        w, _ = ringing(120, 4e-3, "implicit_midpoint", n, 0.0, 1e-7)
        # Static stiffness and mass: the sag's locking factor carries over as its square root.
        softening = math.sqrt(timoshenko_sag(0.0) / sag("hex", n, 0.0))
        error.append(w / BEAM_FREQUENCY / softening - 1.0)
    # Shear and rotary inertia lower w by (k r)^2 (1 + E / (kappa G)) / 2 ~ 0.9 %; sag holds the
    # shear.
    assert abs(error[0]) < 0.02 and abs(error[1]) < 0.02


@pytest.mark.parametrize("damping", ["rayleigh_alpha", "rayleigh_beta"])
def test_rayleigh_damping_ratio(damping):
    """zeta = alpha / (2 w) and beta w / 2, on the first bending mode."""
    w, none = ringing(200, 2e-3, "implicit_midpoint")
    assert abs(none) < 1e-3  # the fit's own error
    value = {"rayleigh_alpha": 0.1 * w, "rayleigh_beta": 0.1 / w}[damping]  # zeta = 0.05
    same, zeta = ringing(200, 2e-3, "implicit_midpoint", **{damping: value})
    assert zeta == pytest.approx(0.05, rel=0.03)
    assert same == pytest.approx(w, rel=5e-3)


@pytest.mark.parametrize(
    "integrator, low, high",
    [("implicit_euler", 0.9, 1.1), ("bdf2", 0.0, 0.1), ("implicit_midpoint", -1e-2, 1e-2)],
)
def test_numerical_damping(integrator, low, high):
    """Implicit Euler damps a mode of angular frequency w by about w h / 2; the others hardly."""
    dt = 4e-3
    w, zeta = ringing(120, dt, integrator)
    assert low <= zeta / (w * dt / 2.0) <= high
