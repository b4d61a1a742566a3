"""Robots swim, walk and roll under plain sinusoids, and untrained networks do not swim."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium", reason="tasks need the extra 'rl'")

import diffsim.envs as envs
from diffsim.control import MLPController, Sinusoid
from diffsim.envs.rollout import Episode, rollout_task

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
