"""Controllers that come with the package replay what was recorded of them."""

import csv
import shutil

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium", reason="learning needs the extra 'rl'")

from diffsim.cli.main import main
from diffsim.control import MLPController
from diffsim.core import optional
from diffsim.learn import trained
from diffsim.learn.setup import evaluate, first_controller


def small() -> trained.Trained:
    """Two short episodes of an untrained network."""
    kept = trained.Trained("CopterHover", {"seconds": 0.2}, 2, 0.0, "nobody", {})
    net = first_controller(kept.make_task(), 3, 5, output_gain=0.5)
    return trained.Trained(**{**vars(kept), "state": trained.stored(net)})


def test_files_give_back_what_was_written(tmp_path) -> None:
    kept = small()
    back = trained.read_trained(trained.write_trained(tmp_path / "one.npz", kept))
    task = back.make_task()
    assert (back.task, back.task_options, back.episodes) == ("CopterHover", {"seconds": 0.2}, 2)
    pair = [k.controller(task).state_dict() for k in (kept, back)]
    for name, value in pair[0].items():
        assert torch.equal(value, pair[1][name])


def test_half_precision_is_near_the_network() -> None:
    task = small().make_task()
    net: MLPController = first_controller(task, 0, 5, output_gain=0.5)
    kept = trained.Trained("CopterHover", {}, 1, 0.0, "", trained.stored(net))
    seen = torch.randn(50, task.num_observations, dtype=torch.float64)
    torch.testing.assert_close(kept.controller(task)(seen), net(seen), rtol=0.0, atol=2e-3)


def test_a_replay_is_the_rating() -> None:
    kept = small()
    task = kept.make_task()
    played = trained.replay(kept, task)
    assert len(played.states) == task.max_steps + 1
    assert played.commands.shape == (10, 2, 4)
    rated = evaluate(task, kept.controller(task), 2)
    assert float(played.rewards.mean()) == pytest.approx(rated, rel=1e-12)


@pytest.mark.parametrize("name", trained.trained_names())
def test_what_is_shipped_is_small_and_belongs_to_its_task(name: str) -> None:
    kept = trained.load_trained(name)
    assert (trained.FOLDER / f"{name}.npz").stat().st_size < 80_000
    assert kept.task == name
    kept.controller(kept.make_task())
    assert "rl/train" in kept.made_by


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.story] * (not name.startswith("Copter")))
        for name in trained.trained_names()
    ],
)
def test_what_is_shipped_earns_what_was_recorded(name: str) -> None:
    """On any instruction set; rewards differ by what chaos makes of rounding."""
    kept = trained.load_trained(name)
    mean = float(trained.replay(kept, kept.make_task()).rewards.mean())
    assert mean == pytest.approx(kept.reward, abs=0.02)


def test_play_writes_film_and_recording(tmp_path, capsys) -> None:
    path = trained.write_trained(tmp_path / "own.npz", small())
    assert main(["play", "--file", str(path), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "recorded 0.0000" in said
    folder = tmp_path / "CopterHover"
    with (folder / "recording.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 10
    assert float(rows[3]["time_s"]) == pytest.approx(0.06)
    image = pytest.importorskip("PIL.Image").open(folder / "film.gif")
    assert image.n_frames == 3
    assert np.asarray(image.convert("RGB")).std() > 5.0


def test_play_checks_first(tmp_path, monkeypatch, capsys) -> None:
    shutil.copy(trained.write_trained(tmp_path / "own.npz", small()), tmp_path / "b.npz")
    monkeypatch.setattr(optional, "present", lambda name: name != "matplotlib")
    assert main(["play", "--file", str(tmp_path / "b.npz"), "--out", str(tmp_path)]) == 2
    assert "pip install 'matplotlib" in capsys.readouterr().err
    assert not (tmp_path / "CopterHover").exists()  # nothing was simulated
    assert main(["play", "SharkSwin", "--no-film"]) == 2
    assert "SharkSwim" in capsys.readouterr().err


def test_play_lists(capsys) -> None:
    assert main(["play", "--no-film"]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in trained.trained_names())
