"""Robots swim, walk and roll under plain sinusoids; the soft jumper's size and swelling."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

import diffsim.envs as envs
from diffsim import soft
from diffsim.control import MLPController, Sinusoid
from diffsim.envs.rollout import Episode, rollout_task
from diffsim.systems import robots
from diffsim.systems.robots.jumper import FIBER_STIFFNESS

pytest.importorskip("gymnasium", reason="tasks need the extra 'rl'")


GAITS = {  # frequency [Hz], amplitudes, phases [rad], least travel [m] in an episode
    "StarfishSwim": (0.6, [0.9] * 4, [0.0] * 4, 0.15),
    "SharkSwim": (0.45, [0.9], [0.0], 0.25),
    "QuadrupedWalk": (7.0, [0.9, 0.3], [0.0, math.pi], 0.04),
    "CowWalk": (6.0, [0.9, 0.3], [0.0, math.pi], 0.08),
    "TorusRoll": (1.0, [0.95] * 8, [math.pi * (0.5 + 0.5 * k) for k in range(8)], 0.12),
}


def task_of(name: str) -> envs.Task:
    legs = {"per_muscle": False} if name in ("QuadrupedWalk", "CowWalk") else {}
    return envs.make_task(name, robot={"coarse": True} | legs)


def play(task: envs.Task, controller: object, seed: int = 0) -> tuple[torch.Tensor, Episode]:
    """How far the center has come, (3,) [m], and the episode."""
    start = task.start(1, np.random.default_rng(seed))
    with torch.no_grad():
        episode = rollout_task(task, controller, start, task.max_steps)
    return (task.robot.center(episode.final["x"]) - task.robot.center(start["x"]))[0], episode


@pytest.mark.parametrize(
    "name",
    [
        *("QuadrupedWalk", "StarfishSwim", "TorusRoll"),
        *(pytest.param(name, marks=pytest.mark.story) for name in ("CowWalk", "SharkSwim")),
    ],
)
def test_sinusoid_advances(name: str) -> None:
    frequency, amplitudes, phases, least = GAITS[name]
    task = task_of(name)
    controller = Sinusoid(
        task.num_actions,
        task.dt,
        frequency=frequency,
        frequency_range=(0.05, 20.0),
        amplitudes=amplitudes,
        phases=phases,
    )
    moved, episode = play(task, controller)
    ahead = float(moved @ task.robot.forward)
    assert ahead > least
    across = moved - ahead * task.robot.forward
    assert float(across[:2].norm()) < 0.25 * ahead
    assert bool(episode.alive.all())
    if name == "TorusRoll":  # it rolls, it does not slide
        turned = task.robot.attitude(episode.final["x"])[0]
        angle = math.atan2(float(turned[0, 2]), float(turned[2, 2]))
        assert angle > math.radians(60.0)
        assert 0.112 * angle == pytest.approx(ahead, rel=0.3)  # outer radius 0.112 m


@pytest.mark.slow
@pytest.mark.parametrize("name", ["StarfishSwim", "SharkSwim"])
def test_untrained_networks_do_not_swim(name: str) -> None:
    task = task_of(name)
    far = []
    for seed in range(4):
        net = MLPController(task.num_observations, task.num_actions, seed=seed, output_gain=1.0)
        far.append(float(play(task, net, seed)[0] @ task.robot.forward))
    assert float(np.mean(far)) < 0.3 * GAITS[name][3]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["StarfishSwim", "SharkSwim"])
def test_gradient_of_a_whole_episode_is_right_and_modest(name: str) -> None:
    """The force of the water is continuous, so 200 steps have a gradient that differences see."""
    task = envs.make_task(name, robot={"coarse": True, "rtol": 1e-8})
    start = task.start(1, np.random.default_rng(0))
    controller = Sinusoid(
        task.num_actions, task.dt, frequency=0.6, amplitudes=[0.9] * task.num_actions
    )

    def total() -> torch.Tensor:
        return rollout_task(task, controller, start, task.max_steps).rewards.sum()

    total().backward()
    exact = float(controller.raw_frequency.grad)
    assert 1.0 < abs(exact) < 1e4
    step, values = 1e-4, []
    with torch.no_grad():
        for sign in (1.0, -2.0):
            controller.raw_frequency += sign * step
            values.append(float(total()))
    assert exact == pytest.approx((values[0] - values[1]) / (2.0 * step), rel=0.05)


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
