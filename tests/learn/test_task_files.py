"""A task by its file is trained, kept, played and resumed by the same scripts; changes are told."""

import shutil

import pytest

pytest.importorskip("gymnasium", reason="learning needs the extra 'rl'")

from diffsim.cli.main import main
from diffsim.envs.task_file import ChangedTaskError
from diffsim.learn import recipe
from diffsim.learn.trained import read_trained
from rl import keep_controller, train_gradient
from tests.envs.soft_files import FISH, HOVER, finger, written
from tests.optional import needs

needs("tensorboard", reason="training writes a TensorBoard log")


@pytest.mark.cpu(9)  # a training, and four scripts on what it left
def test_train_keep_play_and_refuse_after_a_change(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    path = written(tmp_path, finger(control_step=0.01), "finger.yaml")
    words = ["--task", "finger.yaml", "--quick"]
    run = train_gradient.main(words)
    assert run.folder.as_posix() == "runs/finger/gradient/seed_0"
    assert run.finished
    kept = keep_controller.main([str(run.folder), "--out", "kept"])
    assert kept.name == "finger.npz"
    play = ["play", "--file", str(kept), "--out", "played", "--no-film"]
    assert main(play) == 0
    assert (tmp_path / "played" / "finger" / "recording.csv").exists()
    capsys.readouterr()

    path.write_text(path.read_text().replace("seconds: 0.1", "seconds: 0.05"))
    assert main(play) == 2
    assert "seconds was 0.1, is 0.05; restore it" in capsys.readouterr().err
    assert main([*play, "--changed"]) == 0
    with pytest.raises(SystemExit) as ended:
        train_gradient.main([*words, "--resume"])
    assert ended.value.code == 2
    assert "has changed since" in capsys.readouterr().err
    with pytest.raises(ChangedTaskError):
        keep_controller.main([str(run.folder), "--out", "kept"])


def test_a_controller_finds_its_task_beside_it(tmp_path, monkeypatch) -> None:
    made, away = tmp_path / "made", tmp_path / "away"
    made.mkdir()
    monkeypatch.chdir(made)
    written(made, finger(control_step=0.01), "finger.yaml")
    run = train_gradient.main(["--task", "finger.yaml", "--quick"])
    kept = keep_controller.main([str(run.folder), "--out", str(made)])
    shutil.copytree(made, away)
    monkeypatch.chdir(tmp_path)
    trained = read_trained(away / kept.name)
    assert trained.make_task().num_actions == 1
    (away / "finger.yaml").unlink()
    with pytest.raises(FileNotFoundError, match=r"finger\.yaml"):
        trained.make_task()


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (None, "no such task file"),
        (finger(reward=[{"term": "sped"}]), r"reward[0]: term must be one of"),
        ({"task": "Eel"}, "task must be one of"),
    ],
)
def test_scripts_say_what_is_wrong_in_short(tmp_path, capsys, keys, message) -> None:
    path = tmp_path / "task.yaml" if keys is None else written(tmp_path, keys)
    with pytest.raises(SystemExit) as ended:
        train_gradient.main(["--task", str(path), "--out", str(tmp_path / "runs")])
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert message in said
    assert "Traceback" not in said


def test_recipes_of_files_leave_what_the_file_states(tmp_path) -> None:
    assert recipe(str(HOVER)).gradient == recipe("CopterHover").gradient
    assert recipe(str(FISH)).setup["balance_clock"]
    swim = {"task": "SharkSwim", "clock": [2.0]}
    assert "clock" not in recipe(str(written(tmp_path, swim))).task_options
    assert "clock" in recipe("SharkSwim").task_options
