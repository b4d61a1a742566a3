"""Coulomb forces of a few contacts (contact_cone.cpp), against closed forms."""

import math

import numpy as np
import pytest

from diffsim.core.compiled import core

NORMAL = np.array([0.0, 0.6, 0.8])
ACROSS = np.array([1.0, 0.0, 0.0])  # perpendicular to it
LOCAL, COUNT = 1e-3, 5  # m/N: compliance of a contact alone; contacts of one stiff body


def solved(W, free, offset, friction) -> tuple[np.ndarray, bool]:
    """Forces (n, 3) of contacts with one normal, and whether they settled."""
    n = len(free)
    given = {
        "W": np.ascontiguousarray(W),
        "free": np.ascontiguousarray(free),
        "normal": np.tile(NORMAL, (n, 1)),
        "offset": np.full(n, float(offset)),
        "friction": np.full(n, float(friction)),
    }
    force = np.empty((n, 3))
    told = core.contact_cones(
        size=n, force=force.ctypes.data, **{name: v.ctypes.data for name, v in given.items()}
    )
    return force, told


def coupled(shared: float) -> np.ndarray:
    """W of contacts of one body that moves by ``shared`` [m/N] as a whole."""
    blocks = LOCAL * np.eye(COUNT) + shared * np.ones((COUNT, COUNT))
    return np.kron(blocks, np.eye(3))


STIFF = [
    *((shared, mu) for shared in (0.0, 0.5, 1e2, 1e5) for mu in (0.0, 0.3, 5.0)),
    *((shared, math.inf) for shared in (0.0, 0.5)),  # beyond, sweeps alone do not settle
]


@pytest.mark.parametrize(("shared", "friction"), STIFF)
def test_alike_contacts_share_what_one_body_feels(shared, friction):
    """Where a stiff body couples them sweeps take 1e5 rounds; Newton's method takes a few."""
    pushed = -0.02 * NORMAL + 0.012 * ACROSS
    shared = shared * LOCAL
    force, settled = solved(coupled(shared), np.tile(pushed, (COUNT, 1)), 0.01, friction)
    together = LOCAL + COUNT * shared
    normal = 0.03 / together
    held = min(friction * normal, 0.012 / together)  # it sticks, or slips against the push
    expected = normal * NORMAL - held * ACROSS
    assert settled
    np.testing.assert_allclose(force, np.tile(expected, (COUNT, 1)), rtol=1e-6, atol=1e-12)


def test_what_lifts_off_is_free():
    away = np.tile(0.02 * NORMAL + 0.3 * ACROSS, (COUNT, 1))
    force, settled = solved(coupled(LOCAL), away, 0.01, 0.5)
    assert settled and not force.any()


@pytest.mark.parametrize("friction", [0.2, 0.7])
def test_forces_of_a_coupled_body_keep_the_law(friction):
    """Gap, cone and dissipation of each contact, whatever their coupling: the law itself."""
    rng = np.random.default_rng(5)
    factor = rng.normal(size=(3 * COUNT, 6))  # a rigid body has six ways to move
    W = 0.05 * factor @ factor.T + LOCAL * np.eye(3 * COUNT)
    free = rng.normal(size=(COUNT, 3)) * 0.02 - 0.03 * NORMAL
    force, settled = solved(W, free, 0.0, friction)
    assert settled
    moved = free + (W @ force.ravel()).reshape(COUNT, 3)
    gap, pressing = moved @ NORMAL, force @ NORMAL
    slip, pull = moved - gap[:, None] * NORMAL, force - pressing[:, None] * NORMAL
    size, speed = np.linalg.norm(pull, axis=1), np.linalg.norm(slip, axis=1)
    assert (gap > -1e-10).all() and (pressing >= 0.0).all()
    np.testing.assert_allclose(gap * pressing, 0.0, atol=1e-9 * pressing.max())
    assert (size <= friction * pressing * (1.0 + 1e-9)).all()
    slides = (speed > 1e-8) & (pressing > 0.0)
    assert slides.any()
    np.testing.assert_allclose(size[slides], friction * pressing[slides], rtol=1e-6)
    np.testing.assert_allclose((pull * slip).sum(1)[slides], -(size * speed)[slides], rtol=1e-6)
