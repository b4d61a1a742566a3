"""The soft jumper: its size, and how far its material swells."""

from __future__ import annotations

import pytest
import torch
from scipy.optimize import brentq

from diffsim import soft
from diffsim.systems import robots
from diffsim.systems.robots.jumper import FIBER_STIFFNESS

MU = LAMBDA = 1000.0  # [Pa]


def free_stretch(command: float) -> float:
    """Stretch at which a stable neo-Hookean solid is free of stress, F = s 1.

    dpsi/ds = 0 of diffsim.soft.materials' energy and of the fibers: by hand, one axis of three.
    """
    m, volume = 4.0 / 3.0 * MU, LAMBDA + 5.0 / 6.0 * MU

    def stress(s: float) -> float:
        solid = m * s * (1.0 - 1.0 / (3.0 * s**2 + 1.0)) - MU * s**2
        solid += volume * (s**3 - 1.0) * s**2
        return solid + FIBER_STIFFNESS * (s - 1.0) + 300.0 * command

    return float(brentq(stress, 0.5, 1.5, xtol=1e-14))


def test_size_of_the_published_mesh() -> None:
    """204 nodes, 444 tetrahedra, 222 commands there."""
    robot = robots.soft_jumper()
    assert robot.body.mesh.num_nodes == pytest.approx(204, rel=0.15)
    assert robot.body.mesh.num_elements == pytest.approx(444, rel=0.03)
    assert len(robot.command_names) == robot.body.mesh.num_elements // 2
    x = robot.body.x_rest
    assert x[:, 2].min() == 0.0
    torch.testing.assert_close(x.amax(0)[:2], -x.amin(0)[:2])
    assert len(robots.soft_jumper(coarse=True).command_names) == 42


@pytest.mark.parametrize("command", [1.0, 0.4, -1.0])
def test_free_swelling(command: float) -> None:
    """All commands alike scale the body by the closed form."""
    robot = robots.soft_jumper(coarse=True)
    commands = torch.full((len(robot.command_names),), command, dtype=torch.float64)
    stretch = free_stretch(command)

    def largest_force(scale: float) -> float:
        x = scale * robot.body.x_rest
        return float(
            soft.elastic_force(robot.body, x, activation=robot.activation(commands)).abs().max()
        )

    unit = 300.0 * 0.6**2  # stress of a full command on a face [N]
    assert largest_force(stretch) < 1e-11 * unit
    assert largest_force(1.0) > 0.02 * unit
    assert largest_force(2.0 - stretch) > 0.02 * unit  # the other way


def test_the_closed_form_is_linear_elasticity_at_small_strain() -> None:
    stiffness = 3.0 * LAMBDA + 2.0 * MU + FIBER_STIFFNESS  # three times the bulk modulus, and w
    assert free_stretch(1e-3) - 1.0 == pytest.approx(-0.3 / stiffness, rel=1e-3)


def test_one_command_moves_its_two_tetrahedra_alone() -> None:
    robot = robots.soft_jumper(coarse=True)
    commands = torch.zeros(len(robot.command_names), dtype=torch.float64)
    commands[7] = 1.0
    x = robot.body.x_rest
    force = soft.elastic_force(robot.body, x, activation=robot.activation(commands))
    of_pair = torch.unique(robot.body.mesh.elements[14:16])
    moved = torch.nonzero(force.norm(dim=1) > 1e-12).flatten()
    assert set(moved.tolist()) <= set(of_pair.tolist())
    inward = ((x[of_pair].mean(0) - x[moved]) * force[moved]).sum()
    assert float(inward) > 0.0
    torch.testing.assert_close(force.sum(0), torch.zeros(3).double(), atol=1e-12, rtol=0.0)
