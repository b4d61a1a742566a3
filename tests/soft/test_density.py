"""Density per element: mass, weight and frequencies of composite bars, and exact gradients."""

import math

import pytest
import torch
from scipy.linalg import eigh
from scipy.optimize import brentq

from diffsim import mesh, soft
from tests.soft.cases import (
    irregular_mesh,
    soft_body,
)

KINDS = ["hex", "tet"]
YOUNGS_MODULUS, LENGTH = 1e6, 1.0  # [Pa], [m]
NEAR, FAR = 2400.0, 800.0  # density of the half that is held, and of the other [kg/m^3]


def two_density_bar(kind: str, cells: int, **changes) -> soft.SoftBody:
    """A bar along x that is held at x = 0, without lateral contraction, of two halves."""
    make = mesh.hex_box if kind == "hex" else mesh.tet_box
    m = make((cells, 1, 1), (LENGTH, 0.1, 0.1))
    middle = m.x_rest[m.elements].mean(1)[:, 0]
    options = {
        "dt": 1e-3,
        "youngs_modulus": YOUNGS_MODULUS,
        "poissons_ratio": 0.0,
        "density": torch.where(middle < 0.5 * LENGTH, NEAR, FAR).double(),
        "fixed": m.nodes_near_plane("x", 0.0),
        "solver": soft.SolverOptions(rtol=1e-12),
    }
    return soft.SoftBody(m, **{**options, **changes})


@pytest.mark.parametrize("kind", KINDS)
def test_an_element_gives_its_mass_to_its_own_nodes(kind):
    m = irregular_mesh(kind, (3, 2, 1))
    body = soft_body(m)
    volume = mesh.element_volumes(m)
    for e in (0, m.num_elements - 1):
        density = torch.full((m.num_elements,), 1e-9, dtype=torch.float64)
        density[e] = 2.0
        mass = body.physics(density=density).mass
        assert float(mass.sum()) == pytest.approx(float((density * volume).sum()), rel=1e-14)
        own = torch.zeros(m.num_nodes, dtype=torch.bool)
        own[m.elements[e]] = True
        assert bool((mass[own] > 1e-2 * volume[e]).all()) and bool((mass[~own] < 1e-8).all())


def end_shares(m) -> torch.Tensor:
    """Share of each node in a uniform traction on the end at x = l, (num_nodes,) [-]."""
    faces = mesh.surface_triangles(m).faces
    at_end = (m.x_rest[faces][..., 0] == LENGTH).all(1)
    corners = faces[at_end].flatten()  # triangles of equal area
    return torch.bincount(corners, minlength=m.num_nodes).double() / len(corners)


@pytest.mark.parametrize(("kind", "accuracy"), [("hex", 1e-7), ("tet", 1e-5)])
def test_sag_of_a_hanging_bar(kind, accuracy):
    """End of a bar under its weight: u = g l^2 / (8 E) (rho_near + 3 rho_far).

    By reciprocity exact on any mesh of a linear solid; nodes of a tetrahedral bar weigh unequally,
    so its sections warp and its corotated solid is linear to the second order only.
    """
    solver = soft.SolverOptions(rtol=1e-9)
    body = two_density_bar(kind, 8, gravity=(0.1, 0.0, 0.0), solver=solver)
    sag = end_shares(body.mesh) @ (body.static_equilibrium().x - body.x_rest)[:, 0]
    expected = 0.1 * LENGTH**2 / (8.0 * YOUNGS_MODULUS) * (NEAR + 3.0 * FAR)
    assert float(sag) == pytest.approx(expected, rel=accuracy)


def first_axial_frequency(kind: str, cells: int) -> float:
    """Lowest axial mode of the discrete bar, from its tangent and its masses [rad/s]."""
    body = two_density_bar(kind, cells)
    x = body.x_rest
    stiffness = -torch.autograd.functional.jacobian(body.elastic_force, x)
    plane = (x[:, 0] * cells / LENGTH).round().long()
    sections = torch.nn.functional.one_hot(plane, cells + 1).double()[:, 1:]  # the first is held
    reduced = sections.T @ stiffness[:, 0, :, 0] @ sections
    mass = sections.T @ (body.physics().mass[:, None] * sections)
    return math.sqrt(eigh(reduced.numpy(), mass.numpy(), eigvals_only=True)[0])


@pytest.mark.parametrize("kind", KINDS)
def test_frequency_of_a_two_density_bar(kind):
    """Axial waves in a rod of two halves, held at the near end, free at the far one:

    tan(k_1 l / 2) tan(k_2 l / 2) = k_1 / k_2,  k_i = w sqrt(rho_i / E)

    (displacement and force agree at the joint). Lumped masses converge with the second order.
    """

    def mismatch(w: float) -> float:
        near, far = (w * math.sqrt(rho / YOUNGS_MODULUS) for rho in (NEAR, FAR))
        return math.tan(0.5 * near * LENGTH) * math.tan(0.5 * far * LENGTH) - near / far

    end = math.pi / LENGTH * math.sqrt(YOUNGS_MODULUS / NEAR)  # where the near half has its pole
    exact = brentq(mismatch, 1e-3 * end, 0.999 * end, xtol=1e-12)
    errors = [first_axial_frequency(kind, cells) / exact - 1.0 for cells in (8, 16)]
    assert abs(errors[1]) < 1.1e-3
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)


def test_as_many_elements_as_vertices_are_refused():
    """A vector could then mean either."""
    m = mesh.tet_box((2, 1, 1))
    assert m.num_elements == m.num_nodes
    body = soft_body(m)
    with pytest.raises(ValueError, match="may be of elements or of vertices"):
        body.physics(density=torch.ones(m.num_elements, dtype=torch.float64))
    body.physics(density=2.0)
