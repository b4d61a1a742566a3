"""The soft jumper's task: start, reward, observations, and the gradient of a jump."""

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

from diffsim.envs import make_task
from diffsim.envs.task import Task, TaskState

STILL = {"drop": 0.0, "aside": 0.0, "size_spread": 0.0}


def jumper(**options: object) -> Task:
    return make_task("SoftJumper", **{"robot": {"coarse": True}, **options})


def test_starts_are_spread_as_the_data_sheet_says() -> None:
    task = jumper()
    state = task.start(200, np.random.default_rng(0))
    soles = state["x"][..., 2].amin(1)
    assert 0.0 <= soles.min() < 0.02
    assert 0.38 < soles.max() <= 0.4
    width = state["x"][..., 1].amax(1) - state["x"][..., 1].amin(1)
    rest = task.robot.body.x_rest[:, 1]
    size = width / (rest.max() - rest.min())
    assert 0.9 <= size.min() < 0.905
    assert 1.095 < size.max() <= 1.1
    middle = state["x"][..., :2].mean(1)
    assert (middle.abs().amax(0) <= 0.81).all()
    assert (middle.abs().amax(0) > 0.75).all()
    assert not bool(state["v"].any())


def test_reward_of_a_known_motion() -> None:
    """Speed [m/s] + 3 height above the start [m] - 0.001 sum of squared commands."""
    task = jumper(drop=0.3)
    before = task.start(2, np.random.default_rng(1))
    first = {k: v.clone() for k, v in before.items()}
    before["x"] = before["x"] + torch.tensor([0.5, 0.0, 0.2])
    after = {k: v.clone() for k, v in before.items()}
    after["x"] = after["x"] + torch.tensor([0.03, 0.7, -0.05])
    action = torch.full((2, task.num_actions), 0.5, dtype=torch.float64)
    terms = task.reward_terms(before, action, after)
    expected = {
        "forward": 0.03 * 60.0,
        "rise": 3.0 * (0.2 - 0.05),
        "effort": -1e-3 * 42 * 0.25,
    }
    assert set(terms) == set(expected)
    for name, value in expected.items():
        torch.testing.assert_close(terms[name], torch.full((2,), value).double())
    still = task.reward_terms(first, torch.zeros_like(action), first)
    assert not any(bool(value.any()) for value in still.values())


def test_observations_are_in_the_order_of_the_data_sheet() -> None:
    task = jumper(clock=(2.0,))
    state = task.start(1, np.random.default_rng(2))
    action = torch.linspace(-1.0, 1.0, task.num_actions).double()[None]
    state, _ = task.step(state, action)
    seen = task.observe(state)[0]
    center = task.robot.center(state["x"])[0]
    names = [entry.name for entry in task.observations]
    assert len(names) == len(seen)
    assert seen[names.index("center z, times 0.1")] == pytest.approx(0.1 * float(center[2]))
    assert seen[names.index("last command 3")] == action[0, 3]
    node = names.index("node 5 from the center, y, times 0.1")
    assert seen[node] == pytest.approx(0.1 * float(state["x"][0, 5, 1] - center[1]))
    speed = names.index("velocity z of the center, times 0.1")
    assert seen[speed] == pytest.approx(0.1 * float(task.robot.center(state["v"])[0, 2]))
    assert seen[speed] != 0.0
    assert names[-1] == "cosine of a clock of 2 Hz"


def jump(task: Task, amplitude: torch.Tensor) -> tuple[list[TaskState], torch.Tensor]:
    """Shrink for eight control steps, swell for seven."""
    state = task.start(1, np.random.default_rng(0))
    states, total = [], torch.zeros(1, dtype=torch.float64)
    for k in range(15):
        state, reward = task.step(state, (amplitude if k < 8 else -amplitude)[None])
        states.append(state)
        total = total + reward
    return states, total[0]


def test_gradient_of_a_jump_against_central_differences() -> None:
    """From the floor into the air, each command its own share: one direction of 42 numbers."""
    task = jumper(robot={"coarse": True, "rtol": 1e-11}, **STILL)
    amplitude = torch.linspace(0.7, 0.9, task.num_actions, dtype=torch.float64).requires_grad_()
    states, total = jump(task, amplitude)
    touching = [bool(state["contact_force"].abs().max() > 0.0) for state in states]
    assert touching[7]
    assert not touching[-1]
    assert states[-1]["x"][..., 2].min() > 0.0
    total.backward()
    way = torch.cos(torch.arange(task.num_actions).double())
    step = 1e-6
    with torch.no_grad():
        up, down = (jump(task, amplitude + sign * step * way)[1] for sign in (1.0, -1.0))
    assert float(amplitude.grad @ way) == pytest.approx(float(up - down) / (2.0 * step), rel=1e-4)
