"""What the copters' tasks keep from step to step, and when they must not."""

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

from diffsim.copter import load_design
from diffsim.copter.dynamics import flight
from diffsim.envs import Randomization, make_task
from tests import warm


def started(task, batch=2):
    action = torch.full((batch, task.num_actions), 0.1, dtype=torch.float64)
    return task.start(batch, np.random.default_rng(0)), action


@pytest.mark.parametrize("drawn", [None, Randomization({"mass": (0.8, 1.2)})])
def test_parameters_are_packed_once(drawn, monkeypatch):
    count, pack = [], flight.parameter_rows
    monkeypatch.setattr(flight, "parameter_rows", lambda *a: count.append(1) or pack(*a))
    task = make_task("CopterHover", randomization=drawn)
    state, action = started(task)
    for _ in range(5):
        state, _ = task.step(state, action)
    assert len(count) == 1


def test_a_vehicle_changed_in_place_or_replaced_is_flown():
    """Twice the mass falls; what was packed before must not be used."""
    task = make_task("CopterHover")
    state, action = started(task)
    before = task.step(state, action)[0]["velocity"]
    light = task.vehicle
    task.vehicle = light.replace(mass=2.0 * light.mass)
    replaced = task.step(state, action)[0]["velocity"]
    task.vehicle = light
    light.mass.mul_(2.0)
    in_place = task.step(state, action)[0]["velocity"]
    assert bool((replaced[:, 2] > before[:, 2] + 0.05).all())
    assert torch.equal(replaced, in_place)


def test_gradients_reach_the_vehicle_after_a_step_without():
    vehicle = load_design("quadcopter").multicopter()
    mass = vehicle.mass.detach().clone().requires_grad_()
    task = make_task("CopterHover", design=vehicle.replace(mass=mass))
    state, action = started(task)
    with torch.no_grad():
        task.step(state, action)
    for _ in range(2):  # a second backward pass needs a history of its own
        task.step(state, action)[0]["velocity"].sum().backward()
    assert float(mass.grad) != 0.0


def test_a_reference_changed_in_place_is_followed():
    task = make_task("CopterTrack")
    state, _ = started(task)
    before = task.observe(state)
    state["phase"].add_(1.0)
    after = task.observe(state)
    fresh = task.observe({name: value.clone() for name, value in state.items()})
    assert not torch.equal(before, after)
    assert torch.equal(after, fresh)


def test_steps_of_inference_mode():
    task = make_task("CopterTrack")
    with torch.inference_mode():
        state, action = started(task)
        for _ in range(2):
            state, reward = task.step(state, action)
    assert bool(torch.isfinite(reward).all())


FORKED_WORKERS = """
import multiprocessing, gymnasium, torch
import diffsim.envs

torch.set_num_threads(2)
large = torch.rand(400, 400, dtype=torch.float64)
(large @ large).exp().sum()  # PyTorch's pool starts in the parent

def make():
    (large @ large).exp().sum()  # would wait for ever in the child
    return gymnasium.make("diffsim/CopterHover-v0")

multiprocessing.set_start_method("fork")  # what Linux does unless told otherwise, up to Python 3.13
envs = gymnasium.vector.AsyncVectorEnv([make, make])
observation, _ = envs.reset(seed=0)
observation, *_ = envs.step(envs.action_space.sample())
print(observation.shape)
envs.close()
"""


@pytest.mark.story  # three processes
def test_forked_workers_of_gymnasium():
    done = warm.python("-c", FORKED_WORKERS, timeout=90)
    assert done.stdout.split("\n")[0] == "(2, 22)", done.stderr


def test_the_reward_is_that_of_the_data_sheet():
    """Formulas of docs/environments, evaluated anew, about a course that moves."""
    task = make_task("CopterTrack", size=1.2, period=5.0)
    state, action = started(task)
    after = task.step(state, action)[0]
    terms = task.reward_terms(state, action, after)
    time = after["step"].numpy() * task.dt
    turn = 2.0 * np.pi * time / 5.0 + after["phase"].numpy()
    still = np.zeros_like(turn)
    course = 1.2 * np.stack([np.sin(turn), 0.5 * np.sin(2.0 * turn), still], 1)
    rate = 2.0 * np.pi / 5.0
    velocity = 1.2 * rate * np.stack([np.cos(turn), np.cos(2.0 * turn), still], 1)

    def away(error):
        return np.sqrt((error**2).sum(1) + 0.1**2) - 0.1

    expected = {
        "alive": np.ones(2),
        "position": -away(after["position"].numpy() - course) / 3.0,
        "velocity": -0.02 * away(after["velocity"].numpy() - velocity),
        "turning": -0.003 * away(after["body_rates"].numpy()),
        "effort": -0.003 * (action.numpy() ** 2).mean(1),
    }
    assert set(terms) == set(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(terms[name].numpy(), value, rtol=1e-12, err_msg=name)
