"""A soft body's task with what a diagnosis found: sizes, causes, and draws of the posterior."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

import diffsim.envs as envs
from diffsim.core.files import to_plain
from diffsim.data.study import Channel, Run, Study
from diffsim.systems.registry import setup_of
from tests.envs.soft_files import finger, with_model, written

ONE = torch.ones(2, 1, dtype=torch.float64)
YOUNG = {"value": 1e5, "percent": 10}


def recorded() -> dict[str, Any]:
    """The finger as a study describes it: a channel, an uncertain modulus."""
    return with_model(
        finger(),
        material={"youngs_modulus": YOUNG, "density": 1000},
        channels={"tip_z": {"markers": "tip", "axis": "z"}},
    )


def frame_of(keys: dict[str, Any]) -> dict[str, Any]:
    """What a diagnosis of the study would keep of its runs."""
    times = np.linspace(0.0, 1.0, 51)
    bend = 0.2 * np.sin(6.0 * times)
    moved = 0.01 * np.sin(6.0 * times)[:, None]
    study = Study(
        name="finger",
        system="soft_body",
        channels=(Channel("tip_z", "m", "position"),),
        runs=(Run("a", times, moved, {"bend": bend}, "a"),),
        model=keys["model"],
    )
    return to_plain(dict(setup_of(study).model.frame))


def saved(folder: Path, keys: dict[str, Any], effects: dict[str, Any], young: float = 2e5) -> Path:
    path = folder / "extended_model.yaml"
    content = {
        "model": "described soft body",
        "study": "finger",
        "verdict": "named",
        "parameters": {"youngs_modulus": {"value": young, "sd": 2e4, "unit": "Pa"}},
        "effects": effects,
        "frame": frame_of(keys),
    }
    path.write_text(yaml.safe_dump(content))
    return path


def end_of(task: envs.Task, seed: int = 0) -> tuple[envs.TaskState, torch.Tensor]:
    state = task.start(2, np.random.default_rng(seed))
    for _ in range(3):
        state, reward = task.step(state, ONE)
    return state, reward


def test_its_values_are_those_of_the_file(tmp_path) -> None:
    keys = recorded()
    path, model = written(tmp_path, keys), saved(tmp_path, keys, {})
    state, reward = end_of(envs.make_task(path, model=model))
    stiff = with_model(keys, material={"youngs_modulus": 2e5, "density": 1000})
    by_hand, known = end_of(envs.make_task("SoftBody", **stiff))
    torch.testing.assert_close(state["x"], by_hand["x"], rtol=0.0, atol=1e-10)
    torch.testing.assert_close(reward, known)
    soft, _ = end_of(envs.make_task(path))
    assert float((soft["x"] - state["x"]).abs().max()) > 1e-4
    inside = envs.make_task(written(tmp_path, {**keys, "extended_model": model.name}, "b.yaml"))
    torch.testing.assert_close(end_of(inside)[0]["x"], state["x"], rtol=0.0, atol=0.0)


def test_causes_act(tmp_path) -> None:
    keys = recorded()
    cause = {"stiffness_damping": {"value": 0.05, "sd": 0.01, "unit": "s"}}
    path, model = written(tmp_path, keys), saved(tmp_path, keys, cause, young=1e5)
    state, _ = end_of(envs.make_task(path, model=model))
    damped = {"youngs_modulus": 1e5, "density": 1000, "rayleigh_beta": 0.05}
    by_hand, _ = end_of(envs.make_task("SoftBody", **with_model(keys, material=damped)))
    torch.testing.assert_close(state["x"], by_hand["x"], rtol=0.0, atol=1e-10)


def test_each_member_draws_its_own_and_keeps_it(tmp_path) -> None:
    keys = recorded()
    cause = {"stiffness_damping": {"value": 0.02, "sd": 0.002, "unit": "s"}}
    path, model = written(tmp_path, keys), saved(tmp_path, keys, cause)
    task = envs.make_task(path, model=model, posterior=True)
    state, rewards = end_of(task)
    sizes = state["random.model"]
    assert sizes.shape == (2, 2)
    assert float((state["x"][0] - state["x"][1]).abs().max()) > 1e-6
    again, _ = end_of(task)
    torch.testing.assert_close(again["x"], state["x"], rtol=0.0, atol=0.0)
    young, beta = 2e5 * torch.exp(0.1 * sizes[1, 0]), 0.02 + 0.002 * sizes[1, 1]
    material = {"youngs_modulus": float(young), "density": 1000, "rayleigh_beta": float(beta)}
    by_hand, known = end_of(envs.make_task("SoftBody", **with_model(keys, material=material)))
    torch.testing.assert_close(by_hand["x"][0], state["x"][1], rtol=0.0, atol=1e-9)
    torch.testing.assert_close(known[0], rewards[1], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("cause", ["loss_factor", "delay"])
def test_causes_that_need_the_past_are_refused_by_name(tmp_path, cause) -> None:
    keys = recorded()
    entry = {"value": 0.05, "sd": 0.01, "unit": "s" if cause == "delay" else "-"}
    path, model = written(tmp_path, keys), saved(tmp_path, keys, {cause: entry})
    with pytest.raises(ValueError, match=f"{cause} needs time or the past"):
        envs.make_task(path, model=model)


def test_other_files_are_refused(tmp_path) -> None:
    keys = recorded()
    path, model = written(tmp_path, keys), saved(tmp_path, keys, {})
    with pytest.raises(ValueError, match="posterior needs an extended_model"):
        envs.make_task(path, posterior=True)
    with pytest.raises(FileNotFoundError, match="no such extended model"):
        envs.make_task(path, model="none.yaml")
    outside = written(tmp_path, {**keys, "extended_model": "../extended_model.yaml"}, "c.yaml")
    with pytest.raises(ValueError, match="must stay in its folder"):
        envs.make_task(outside)
    model.write_text(model.read_text().replace("described soft body", "multicopter"))
    with pytest.raises(ValueError, match="a model of multicopter, not of a soft body"):
        envs.make_task(path, model=model)
