"""Bodies of several materials: stiffness, Poisson's ratio and density per element."""

from __future__ import annotations

import pytest
import torch

from diffsim import mesh, soft
from tests.soft.cases import forward_and_reverse, leaf, noise, soft_body

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


def test_gradient_of_springs_in_series():
    """d elongation / dE_i = -F l_i / (A E_i^2), each element on its own."""
    body = layered_bar()
    modulus = leaf(body.youngs_modulus.detach())
    force = 1e-4 * SOFT_MODULUS * SIDE**2
    physics = body.physics(youngs_modulus=modulus)
    end = body.static_equilibrium(external_force=pulled(body, force), physics=physics).x
    tip = body.mesh.nodes_near_plane("x", LENGTH)
    (found,) = torch.autograd.grad(end[tip, 0].mean(), modulus)
    expected = -force / SIDE**2 * (LENGTH / 6) / modulus.detach() ** 2
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=0.0)


@pytest.mark.grad
@pytest.mark.parametrize("kind", ["hex", "tet"])
@pytest.mark.parametrize("preconditioner", ["constant", "multigrid"])
@pytest.mark.parametrize("batch", [None, 2])
def test_gradients_of_all_three_at_a_contrast_of_100(kind, preconditioner, batch):
    """Finite differences through a rollout, alone and in a batch."""
    solver = soft.SolverOptions(method="newton_pcg", preconditioner=preconditioner, rtol=1e-10)
    body = layered_bar(kind, cells=(3, 1, 1), solver=solver, poissons_ratio=0.3)
    count = body.mesh.num_elements
    start = body.rest_state(batch)
    start = soft.State(start.x, 0.3 * noise(*start.x.shape, seed=3))
    base = body.youngs_modulus.detach()

    def layer(stiffer, ratio, heavier):
        physics = body.physics(
            youngs_modulus=base * stiffer, poissons_ratio=ratio, density=10.0 * heavier
        )
        return soft.rollout(body, start, 2, physics=physics).x[-1]

    args = [leaf(1.0 + 0.1 * noise(count, seed=k).tanh()) for k in (4, 5)]
    ratio = leaf(0.3 + 0.1 * noise(count, seed=6).tanh())
    args = (args[0], ratio, args[1])
    weight = noise(*start.x.shape, seed=7)
    grads = torch.autograd.grad((weight * layer(*args)).sum(), args)
    for k, (name, grad) in enumerate(
        zip(("youngs_modulus", "poissons_ratio", "density"), grads, strict=True)
    ):
        direction, h = noise(count, seed=8 + k), 5e-4

        def along(t: float, moving: int = k, direction: torch.Tensor = direction) -> float:
            moved = [
                a.detach() + (t * direction if i == moving else 0.0) for i, a in enumerate(args)
            ]
            return float((weight * layer(*moved)).sum())

        # of the fourth order, since second derivatives are large at this contrast
        slope = (8 * (along(h) - along(-h)) - (along(2 * h) - along(-2 * h))) / (12 * h)
        assert float(grad @ direction) == pytest.approx(slope, rel=1e-4), name
        assert bool((grad != 0).all()), name


def test_forward_mode_agrees_with_the_adjoint_at_a_contrast_of_100():
    """<w, J p> = <J'w, p> for the moduli of single elements."""
    solver = soft.SolverOptions(method="newton_pcg", preconditioner="multigrid", rtol=1e-10)
    body = layered_bar(solver=solver, gravity=(0.0, 0.0, -9.81))
    forward, reverse = forward_and_reverse(body, "youngs_modulus", body.youngs_modulus.detach())
    assert forward == pytest.approx(reverse, rel=1e-8)
