"""Tasks by file: found, checked and made by the same names as tasks of the package."""

import json
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import torch

gymnasium = pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

import diffsim.envs as envs  # noqa: E402
from diffsim.core import plugins  # noqa: E402
from diffsim.envs import registry  # noqa: E402
from diffsim.envs.copter_tasks import CopterHover  # noqa: E402
from diffsim.envs.task_file import (  # noqa: E402
    ChangedTaskError,
    read_task_file,
    record_of,
    require_unchanged,
    task_label,
)
from tests.envs.soft_files import FISH, HOVER, finger, written  # noqa: E402


def test_a_copter_of_a_vehicle_file_flies() -> None:
    task = envs.make_task(HOVER, seconds=0.1)
    assert isinstance(task, CopterHover)
    assert (task.name, task.max_steps, task.num_actions) == ("hover", 5, 4)
    assert float(task.vehicle.mass) == pytest.approx(1.2)
    weight = float(task.trim.sum())
    assert weight == pytest.approx(1.2 * 9.81, rel=1e-3)
    env = gymnasium.make("diffsim/Task-v0", name=HOVER, seconds=0.1)
    env.reset(seed=0)
    _, reward, *_ = env.step(np.zeros(4, dtype=np.float32))
    assert -1.0 < reward < 1.0


def test_rotors_of_the_vehicle_say_how_motors_lag(tmp_path) -> None:
    text = (HOVER.parent / "my_quad.yaml").read_text()
    (tmp_path / "slow.yaml").write_text(text.replace("15 mm}", "15 mm, time_constant: 80 ms}"))
    path = written(tmp_path, {"task": "CopterHover", "vehicle": "slow.yaml"})
    lag = envs.make_task(path)._effects.motor_lag
    torch.testing.assert_close(lag.time_constants, torch.full((4,), 0.08).double())
    stated = envs.make_task(path, motor_time_constant=0.05)._effects.motor_lag
    assert float(stated.time_constants[0]) == pytest.approx(0.05)


def test_mjcf_flies_as_it_is(tmp_path) -> None:
    pytest.importorskip("mujoco", reason="MuJoCo reads MJCF")
    places = [(0.14, -0.18), (-0.14, 0.18), (0.14, 0.18), (-0.14, -0.18)]
    sites = "".join(f'<site name="r{k}" pos="{x} {y} 0.05"/>' for k, (x, y) in enumerate(places))
    motors = "".join(
        f'<motor name="m{k}" site="r{k}" ctrlrange="0 13" gear="0 0 1 0 0 {0.02 * s}"/>'
        for k, s in enumerate((1, 1, -1, -1))
    )
    (tmp_path / "x.xml").write_text(
        '<mujoco><worldbody><body name="b"><freejoint/><inertial pos="0 0 0" mass="1.3" '
        f'diaginertia="0.04 0.03 0.06"/>{sites}</body></worldbody><actuator>{motors}'
        "</actuator></mujoco>"
    )
    path = written(tmp_path, {"task": "CopterTrack", "vehicle": "x.xml", "size": 1.0})
    task = envs.make_task(path)
    assert float(task.vehicle.mass) == pytest.approx(1.3)


def test_named_tasks_and_shipped_designs_by_file(tmp_path) -> None:
    path = written(tmp_path, {"task": "CopterHover", "design": "pentacopter", "seconds": 0.2})
    assert envs.make_task(str(path)).num_actions == 5
    swim = {"task": "SharkSwim", "robot": {"coarse": True}, "num_steps": 3}
    assert envs.make_task(written(tmp_path, swim, "swim.yml")).max_steps == 3


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"task": "CopterHove"}, "did you mean|closest|CopterHover"),
        ({"seconds": 3}, r"task must name a kind of task"),
        ({"task": "CopterHover", "secnds": 3}, r"secnds.*did you mean 'seconds'"),
        ({"task": "CopterHover", "seconds": -3}, "seconds must lie in"),
        ({"task": "CopterHover", "vehicle": "../quad.yaml"}, "must stay in its folder"),
        ({"task": "CopterHover", "vehicle": "/etc/passwd"}, "relative to its folder"),
        ({"task": "CopterHover", "vehicle": 3}, "vehicle must name a file, got 3"),
        ({"task": "CopterHover", "model": "../extended_model.yaml"}, "must stay in its folder"),
        ({"task": "CopterHover", "vehicle": "none.yaml"}, "vehicle: no such file"),
    ],
)
def test_mistakes_are_told_with_the_file(tmp_path, keys, message) -> None:
    path = written(tmp_path, keys)
    with pytest.raises((ValueError, FileNotFoundError), match=message) as caught:
        envs.make_task(path)
    assert str(path) in str(caught.value)


def test_other_things_than_task_files_are_refused(tmp_path) -> None:
    with pytest.raises(FileNotFoundError, match="no such task file"):
        envs.make_task("nowhere/eel.yaml")
    (tmp_path / "list.yaml").write_text("- 1\n")
    with pytest.raises(ValueError, match="must be a mapping with `task: NAME`"):
        envs.make_task(tmp_path / "list.yaml")
    (tmp_path / "code.yaml").write_text("task: !!python/object/apply:os.getcwd []\n")
    with pytest.raises(ValueError, match="line 1"):
        envs.make_task(tmp_path / "code.yaml")
    link = tmp_path / "safe"
    link.mkdir()
    (link / "quad.yaml").symlink_to(HOVER.parent / "my_quad.yaml")
    path = written(link, {"task": "CopterHover", "vehicle": "quad.yaml"})
    with pytest.raises(ValueError, match="is a link that leaves it"):
        envs.make_task(path)


def test_files_of_the_page_are_tasks(tmp_path) -> None:
    page = (FISH.parents[3] / "docs" / "learning.md").read_text()
    finger_file, *_ = re.findall(r"```yaml\n(task: SoftBody.*?)```", page, re.S)
    (tmp_path / "finger.yaml").write_text(finger_file)
    task = envs.make_task(tmp_path / "finger.yaml")
    state = task.start(2, np.random.default_rng(0))
    for _ in range(3):
        state, reward = task.step(state, torch.ones(2, 1, dtype=torch.float64))
    assert bool((reward < 0.0).all())
    assert (task.max_steps, task.num_observations) == (50, 9)
    hover, *_ = re.findall(r"```yaml\n(task: CopterHover.*?)```", page, re.S)
    (tmp_path / "my_quad.yaml").write_text((HOVER.parent / "my_quad.yaml").read_text())
    (tmp_path / "hover.yaml").write_text(hover)
    assert envs.make_task(tmp_path / "hover.yaml").num_actions == 4


class Entry:
    """An entry point of another package."""

    dist = None

    def __init__(self, name: str, made: object):
        self.name, self.value, self._made = name, f"eels:{name}", made

    def load(self) -> object:
        return self._made


def test_another_package_adds_a_task_by_its_file(tmp_path, monkeypatch) -> None:
    path = written(tmp_path, finger())
    found = {"Eel": Entry("Eel", str(path)), "Bad": Entry("Bad", 3)}
    monkeypatch.setattr(registry, "find_plugins", lambda group: found)
    monkeypatch.setattr(plugins, "find_plugins", lambda group: found)
    registry.register()
    try:
        env = gymnasium.make("diffsim/Eel-v0")
        assert env.unwrapped.task.num_actions == 1
        assert envs.make_task("Eel", seconds=0.06).max_steps == 3
        with pytest.raises(ValueError, match="or the path of a YAML file, got 3"):
            envs.make_task("Bad")
    finally:
        for name in found:
            gymnasium.registry.pop(f"diffsim/{name}-v0", None)


def test_a_record_tells_what_has_changed(tmp_path) -> None:
    (tmp_path / "fish.inp").write_bytes((FISH.parent / "fish.inp").read_bytes())
    path = tmp_path / "fish.yaml"
    path.write_text(FISH.read_text())
    record = json.loads(json.dumps(record_of(path)))
    assert list(record["files"]) == ["fish.inp"]
    require_unchanged(path, record, "it")
    path.write_text("# a comment changes nothing\n" + FISH.read_text())
    assert read_task_file(path).differences(record) == []
    path.write_text(FISH.read_text().replace("seconds: 4", "seconds: 5"))
    with (tmp_path / "fish.inp").open("a") as file:
        file.write("**\n")
    with pytest.raises(ChangedTaskError, match=r"seconds was 4, is 5; the file fish.inp has ch"):
        require_unchanged(path, record, "it")
    many = {**record, "files": dict.fromkeys("abcdefgh", "0")}
    with pytest.raises(ChangedTaskError, match=r"it: (?:[^;]*; ){4}and 6 more; restore"):
        require_unchanged(path, many, "it")
    require_unchanged("CopterHover", None, "it")
    assert record_of("CopterHover") is None


def test_labels_and_pickled_tasks() -> None:
    assert [task_label(n) for n in ("SharkSwim", "a/eel.yaml", Path("b.yml"))] == [
        "SharkSwim",
        "eel",
        "b",
    ]
    task = envs.make_task("SoftBody", **finger(seconds=0.06))
    task.max_steps = 2
    copy = pickle.loads(pickle.dumps(task))
    assert (copy.max_steps, copy.name) == (2, "SoftBody")
