"""What every term of a reward pays, against its data sheet: each once more, in numpy."""

from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

import diffsim.envs as envs
from diffsim.envs.rewards import SMOOTH, TERMS, ControlStep
from tests.envs.soft_files import finger, with_model

TURN = torch.linalg.matrix_exp(
    torch.tensor([[0.0, -0.5, 0.2], [0.5, 0.0, -0.3], [-0.2, 0.3, 0.0]], dtype=torch.float64)
)
ALONG, PER = np.array([0.2, -0.3, 0.9]), 0.3
KEYS = {"speed": {"along": ALONG, "per": PER}, "drift": {"along": ALONG, "per": PER},
        "upright": {"axis": "x"}, "energy": {"per": PER}}  # fmt: skip


@pytest.fixture(scope="module")
def step() -> ControlStep:
    """Two bodies that turned and moved as one, each under other actions."""
    task = envs.make_task("SoftBody", **with_model(finger(), fixed=[]))
    robot = task.robot
    rest = robot.body.x_rest
    shift = torch.tensor([[0.02, 0.01, -0.03], [-0.01, 0.03, 0.02]], dtype=torch.float64)
    before = rest @ TURN.T
    actions = torch.tensor([[[0.3], [-0.9]], [[-0.2], [0.4]]], dtype=torch.float64)
    return ControlStep(
        robot=robot,
        dt=0.02,
        x_before=before.expand(2, -1, 3),
        x=before + shift[:, None],
        action=actions[0],
        action_before=actions[1],
        command=0.2 * actions[0],
        command_before=0.2 * actions[1],
        physics=robot.physics({}),
        goal=torch.tensor([[0.1, 0.2, 0.3], [0.0, 0.05, 0.1]], dtype=torch.float64),
        goal_markers=("tip", "middle"),
    )


def center(s: ControlStep, x: torch.Tensor) -> Any:
    """Of the mass: every cell has the same, and gives each of its corners an eighth."""
    mass = np.bincount(s.robot.body.mesh.elements.flatten().numpy(), minlength=x.shape[-2])
    return np.einsum("n,...ni->...i", mass / mass.sum(), x.numpy())


def velocity(s: ControlStep) -> Any:
    return (center(s, s.x) - center(s, s.x_before)) / s.dt / PER


def smooth(vectors: Any) -> Any:
    return np.sqrt((vectors**2).sum(-1) + SMOOTH**2) - SMOOTH


def missing(s: ControlStep) -> Any:
    """From the middle of the markers to the goal, in lengths of the bar of 8 cm."""
    at_rest = torch.tensor([[0.08, 0.01, 0.01], [0.04, 0.01, 0.01]], dtype=torch.float64)
    shift = center(s, s.x) - center(s, s.x_before)
    seen = (at_rest @ TURN.T).mean(0).numpy() + shift
    return (s.goal.numpy() - seen) / 0.08


def spent(s: ControlStep) -> Any:
    """Elastic energy that the muscles' new length of rest makes, at the same shape."""
    energies = [
        s.robot.body.elastic_energy(
            s.x_before, activation=s.robot.activation(c), physics=s.physics
        ).numpy()
        for c in (s.command, s.command_before)
    ]
    return np.maximum(energies[0] - energies[1], 0.0) / s.dt / PER


WAY = ALONG / np.linalg.norm(ALONG)
SHEETS = {
    "speed": lambda s: velocity(s) @ WAY,
    "drift": lambda s: -smooth(np.cross(velocity(s), WAY)),
    "distance": lambda s: -smooth(missing(s)),
    "height": lambda s: (center(s, s.x) - center(s, s.robot.body.x_rest))[:, 2] / 0.08,
    "upright": lambda s: np.full(2, float(TURN[0, 0])),
    "effort": lambda s: -(s.action.numpy()[:, 0] ** 2),
    "change": lambda s: -((s.action - s.action_before).numpy()[:, 0] ** 2),
    "energy": lambda s: -spent(s),
    "alive": lambda s: np.ones(2),
}


@pytest.mark.reference
@pytest.mark.parametrize("name", TERMS)
def test_a_term_pays_what_its_sheet_says(name: str, step: ControlStep) -> None:
    earned = TERMS[name](term=name, **KEYS.get(name, {})).earned(step)
    wanted = SHEETS[name](step)
    assert earned.shape == (2,) and np.ptp(wanted) + abs(wanted).max() > 1e-3
    np.testing.assert_allclose(earned.numpy(), wanted, rtol=1e-9, atol=1e-12)


def test_weights_are_factors() -> None:
    task = envs.make_task("SoftBody", **finger(reward=[{"term": "effort", "weight": 0.25}]))
    state = task.start(1, np.random.default_rng(0))
    assert float(task.step(state, torch.full((1, 1), 0.6).double())[1]) == pytest.approx(-0.09)
