"""Bodies of several materials: stiffness, Poisson's ratio and density per element."""

import pytest
import torch

from diffsim import mesh, soft
from tests.soft.cases import soft_body

LENGTH, SIDE = 1.2, 0.2
SOFT_MODULUS = 1e4  # [Pa]


def layered_bar(kind="hex", contrast=100.0, cells=(6, 1, 1), **changes) -> soft.SoftBody:
    """A bar along x, held at x = 0 without lateral contraction, its middle third stiffer."""
    m = (mesh.hex_box if kind == "hex" else mesh.tet_box)(cells, (LENGTH, SIDE, SIDE))
    arguments = {
        "youngs_modulus": torch.where(in_the_middle(m), contrast * SOFT_MODULUS, SOFT_MODULUS),
        "poissons_ratio": 0.0,
        "density": torch.where(in_the_middle(m), 30.0, 10.0).double(),
        "gravity": (0.0, 0.0, 0.0),
        "fixed": m.nodes_near_plane("x", 0.0),
        "solver": soft.SolverOptions(rtol=1e-6),
    }
    arguments["youngs_modulus"] = arguments["youngs_modulus"].double()
    return soft_body(m, **{**arguments, **changes})


def in_the_middle(m) -> torch.Tensor:
    center = m.x_rest[m.elements].mean(1)[:, 0]
    return (center > LENGTH / 3) & (center < 2 * LENGTH / 3)


def pulled(body: soft.SoftBody, force: float) -> torch.Tensor:
    """Nodal forces of a uniform traction on the end of a bar of one hexahedron across [N]."""
    load = torch.zeros_like(body.x_rest)
    end = body.mesh.nodes_near_plane("x", LENGTH)
    load[end, 0] = force / len(end)
    return load


@pytest.mark.parametrize("contrast", [1.0, 10.0, 100.0, 1e4])
def test_springs_in_series(contrast):
    """Small pull: the elongation is F / A times the sum of length over modulus."""
    body = layered_bar(contrast=contrast)
    force = 1e-4 * SOFT_MODULUS * SIDE**2
    end = body.static_equilibrium(external_force=pulled(body, force)).x
    found = float((end - body.x_rest)[:, 0].max())
    third = LENGTH / 3
    expected = force / SIDE**2 * (2 * third / SOFT_MODULUS + third / (contrast * SOFT_MODULUS))
    assert found == pytest.approx(expected, rel=2e-4)  # the strain is 1e-4
