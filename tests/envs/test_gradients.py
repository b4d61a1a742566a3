"""What ``differentiable_step`` and whole episodes return has the right gradients."""

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

import diffsim.envs as envs
from diffsim.control import MLPController, Sinusoid
from diffsim.envs.rollout import rollout_task
from diffsim.envs.soft_tasks import Advance, Reach
from tests.envs.cases import COARSE, block


def check_step(task: envs.Task, state: envs.TaskState, names: tuple[str, ...]) -> None:
    """Gradients of the next state and the reward against finite differences."""
    env = envs.TaskEnv(task)
    action = 0.6 * torch.linspace(-1.0, 1.0, task.num_actions + 2)[1:-1].double()[None]

    def function(action: torch.Tensor, *values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        after, reward = env.differentiable_step(
            state | dict(zip(names, values, strict=True)), action
        )
        return (*(after[name] for name in names), task.observe(after), reward)

    inputs = [state[name].clone().requires_grad_() for name in names]
    assert torch.autograd.gradcheck(
        function, (action.requires_grad_(), *inputs), eps=1e-6, atol=1e-5, rtol=1e-4
    )


@pytest.mark.parametrize("surroundings", ["air", "water", "floor"])
def test_step_of_a_soft_robot(surroundings: str) -> None:
    robot = block(water=surroundings == "water", on_floor=surroundings == "floor")
    task = Advance(robot, 5, substeps=2, rise_weight=0.3)
    state = task.start(1, np.random.default_rng(0))
    generator = torch.Generator().manual_seed(0)
    state["x"] = state["x"] + 2e-3 * torch.rand(state["x"].shape, generator=generator).double()
    state["v"] = 0.2 * torch.rand(state["v"].shape, generator=generator).double()
    if surroundings == "floor":  # the lower nodes in firm contact, sliding
        state["x"][..., 2] = task.robot.body.x_rest[:, 2]
        state["v"][..., 2] = -0.1
        state["v"][..., 0] = 1.0
    check_step(task, state, ("x", "v"))


def test_step_of_the_reacher() -> None:
    robot = block()
    task = Reach(robot, 5, goal_low=(-0.1,) * 3, goal_high=(0.1,) * 3)
    check_step(task, task.start(1, np.random.default_rng(1)), ("x", "v", "goal"))


@pytest.mark.parametrize(
    ("name", "steps", "options", "tolerance"),
    [
        ("SharkSwim", 20, {"robot": {"coarse": True, "rtol": 1e-9}}, 1e-4),
        ("StarfishSwim", 15, {"robot": {"coarse": True, "rtol": 1e-9}}, 1e-4),
        ("TendonReach", 8, {"robot": {"coarse": True, "rtol": 1e-9}}, 1e-4),
        ("TorusRoll", 5, {"robot": {"coarse": True, "rtol": 1e-9}}, 1e-3),
        ("CopterTrack", 50, {}, 1e-5),
    ],
)
def test_episode_against_central_differences(
    name: str, steps: int, options: dict, tolerance: float
) -> None:
    task = envs.make_task(name, **options)
    start = task.start(2, np.random.default_rng(0))
    controller = Sinusoid(task.num_actions, task.dt, frequency=2.0)

    def total() -> torch.Tensor:
        return rollout_task(task, controller, start, steps).rewards.sum()

    total().backward()
    parameters = [controller.raw_frequency, controller.raw_amplitude, controller.phase]
    generator = torch.Generator().manual_seed(1)
    ways = [torch.rand(p.shape, generator=generator).double() for p in parameters]
    exact = sum(float((p.grad * w).sum()) for p, w in zip(parameters, ways, strict=True))
    step, values = 1e-5, []
    with torch.no_grad():
        for sign in (1.0, -2.0):
            for p, w in zip(parameters, ways, strict=True):
                p += sign * step * w
            values.append(float(total()))
    assert exact == pytest.approx((values[0] - values[1]) / (2.0 * step), rel=tolerance)


def test_network_learns_through_the_vector_and_single_environment_alike() -> None:
    """A batch's gradient is the mean of its members' gradients."""
    task = envs.make_task("SharkSwim", **COARSE)
    start = task.start(2, np.random.default_rng(0))
    net = MLPController(task.num_observations, task.num_actions, output_gain=1.0)

    def gradient(state: envs.TaskState) -> torch.Tensor:
        net.zero_grad()
        rollout_task(task, net, state, 4).rewards.mean().backward()
        return torch.cat([p.grad.flatten() for p in net.parameters()])

    parts = [gradient({k: v[i : i + 1] for k, v in start.items()}) for i in range(2)]
    both = gradient(start)
    assert float(both.norm()) > 0.0
    torch.testing.assert_close(both, 0.5 * (parts[0] + parts[1]), rtol=1e-9, atol=1e-12)


def test_cut_horizon_forgets() -> None:
    task = Advance(block(water=True), 4)
    start = task.start(1, np.random.default_rng(0))
    start["v"] = start["v"].clone().requires_grad_()
    net = Sinusoid(1, task.dt)
    rollout_task(task, net, start, 4, cut_every=2).rewards[2:].sum().backward()
    assert start["v"].grad is None or not bool(start["v"].grad.any())
    with pytest.raises(ValueError, match="cut_every"):
        rollout_task(task, net, start, 4, cut_every=0)


def test_a_differentiable_state_goes_on_from_where_the_environment_is() -> None:
    env = envs.TaskEnv(envs.make_task("CopterHover"))
    env.reset(seed=3)
    action = np.full(env.task.num_actions, 0.2, dtype=np.float32)
    env.step(action)
    state = env.differentiable_state()
    _, reward, *_ = env.step(action)
    _, expected = env.differentiable_step(state, torch.from_numpy(action).double()[None])
    assert reward == pytest.approx(float(expected), rel=1e-12)
    assert int(state["step"]) == 1  # a copy: the environment's own step left it alone
