"""``diffsim diagnose check`` in a user's folder: what is there, what is wrong, before any run."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from diffsim import cli

SIMULATOR = """
import numpy as np

def predict(parameters, run):
    return (parameters["gain"] * run.command["force"])[:, None]
"""
BASE: dict[str, Any] = {
    "name": "rig",
    "model": {
        "system": "outside",
        "simulator": "sim.py:predict",
        "parameters": {"gain": {"value": 2.0, "sd": 0.5}},
    },
    "time": {"column": "t (ms)", "unit": "ms"},
    "channels": [{"name": "position", "column": "x", "unit": "mm", "sd": 0.1}],
    "commands": [{"name": "force", "column": "F", "unit": "N", "lower": -5, "upper": 5}],
    "runs": [
        {"name": "a", "file": "a.csv", "group": "slow"},
        {"name": "b", "file": "b.csv", "repeat_of": "a"},
        {"name": "c", "file": "c.csv", "use": "select", "setup": {"payload": "A"}},
        {"name": "d", "file": "d.csv", "use": "test", "until_s": 0.3},
    ],
}


def write_run(path: Path, seed: int, rate: float) -> None:
    t = np.arange(40) * 10.0
    force = np.sin(rate * t / 100.0)
    x = 2.0 * force + 0.1 * np.random.default_rng(seed).normal(size=40)
    rows = [f"{a:g},{b!r},{c!r},7" for a, b, c in zip(t, x.tolist(), force.tolist(), strict=True)]
    path.write_text("\n".join(["t (ms),x,F,counter", *rows]) + "\n")


@pytest.fixture
def folder(tmp_path):
    for seed, (name, rate) in enumerate(zip("abcd", (1.0, 1.0, 2.0, 3.0), strict=True)):
        write_run(tmp_path / f"{name}.csv", seed, rate)
    (tmp_path / "sim.py").write_text(SIMULATOR)
    return tmp_path


def check(folder: Path, capsys, **changes: Any):
    (folder / "study.yaml").write_text(yaml.safe_dump({**BASE, **changes}))
    code = cli.main(["diagnose", "check", str(folder)])
    said = capsys.readouterr()
    return code, said.out, said.err


def test_a_study_is_shown_with_what_its_uses_imply(folder, capsys):
    code, out, _ = check(folder, capsys)
    assert code == 0, out
    assert "rig: 4 runs, 1 channel" in out
    shown = {line.split()[0]: line.split() for line in out.splitlines() if line.strip()}
    assert shown["position"][1:4] == ["mm", "position", "0.1"]
    assert shown["force"][1] == "N" and "-5 .. 5" in out
    assert shown["c"][1:4] == ["select", "-", "40"] and "payload=A" in out
    assert shown["d"][1:4] == ["test", "-", "30"]
    assert "select: c; these choose between causes" in out
    assert "test: d; touched once" in out
    assert "One row of the record is 10 ms" in out
    assert "repeats: 2 runs of slow" in out and "repeats of position differ" not in out
    assert "not used: columns: counter (4 files)" in out
    assert "not used: run d: 10 of 40 samples, by its window" in out
    assert "model: 1 base parameters (gain; play_start, 4 more, one per run: only" in out
    assert "ready for a diagnosis" in out


def test_repeats_that_differ_as_recorded_are_told_before_a_search(folder, capsys):
    head, *rows = (folder / "b.csv").read_text().splitlines()
    values = [row.split(",") for row in rows]
    moved = [",".join([t, repr(float(x) + 1.0), *rest]) for t, x, *rest in values]
    (folder / "b.csv").write_text("\n".join([head, *moved]) + "\n")
    code, out, _ = check(folder, capsys)
    assert code == 0, out
    # two runs that are 1 mm apart: an sd of 1 / sqrt(2) of a single one, and the noise's 0.1 mm
    assert "repeats of position differ by 0.7" in out and " mm as they were recorded, 7" in out


def test_what_was_recorded_beside_is_said(folder, capsys):
    for path in folder.glob("*.csv"):
        head, *rows = path.read_text().splitlines()
        warm = [f"{row},{20.0 + (7 * i) % 11}" for i, row in enumerate(rows)]
        path.write_text("\n".join([f"{head},temp [degC]", *warm]) + "\n")
    code, out, _ = check(folder, capsys)
    assert code == 0, out
    assert "recorded beside: temp [K]; what is left may depend on them" in out
    assert "not used: columns: counter (4 files)" in out


def test_without_select_and_test_runs(folder, capsys):
    code, out, _ = check(folder, capsys, runs=BASE["runs"][:2])
    assert code == 0
    assert "select: none; causes are chosen by leaving out one fit run" in out
    assert "test: none; nothing will show what the causes found are worth" in out
    assert "warning: study: no run with use: test" in out
    assert "warning: study: all fit runs have one command" in out


def test_a_study_of_test_runs_is_checked_for_judge(folder, capsys):
    runs = [{"name": "new", "file": "c.csv", "use": "test"}]
    code, out, _ = check(folder, capsys, runs=runs)
    assert code == 0
    assert "note: study: no run with use: fit" in out
    assert "model: 1 base parameters" in out
    assert f"ready to be judged: diffsim diagnose judge {folder} --model" in out
    (folder / "sim.py").write_text("def predict(parameters, run):\n    return 1 +\n")
    code, out, _ = check(folder, capsys, runs=runs)
    assert code == 2 and "error: model: " in out


def test_mistakes_of_the_description_are_told_together(folder, capsys):
    model = {**BASE["model"], "simulater": "x", "workers": 0, "parameters": {"gain": "TODO"}}
    code, out, err = check(folder, capsys, model=model, todo=["Weigh the cart"])
    assert code == 2
    assert "no key 'simulater' here; did you mean 'simulator'" in out
    assert "error: model.parameters.gain: is still to be filled in: TODO" in out
    assert "warning: study: still to be stated: Weigh the cart" in out
    assert "keep" in err


def test_what_only_making_the_model_shows_is_told(folder, capsys):
    (folder / "sim.py").write_text("def predict(parameters, run):\n    return 1 +\n")
    code, out, _ = check(folder, capsys)
    assert code == 2
    assert "error: model: " in out


def test_what_many_runs_have_is_told_once(folder, capsys):
    for name in "abc":
        lines = (folder / f"{name}.csv").read_text().splitlines()
        (folder / f"{name}.csv").write_text("\n".join([*lines[:20], *lines[24:]]) + "\n")
    code, out, _ = check(folder, capsys)
    assert code == 0
    (line,) = (line for line in out.splitlines() if "gaps in the clock" in line)
    assert line.startswith("warning: run a: 1 gaps") and line.endswith("(likewise b, c)")


def test_one_recording_in_two_frames_is_told(folder, capsys):
    for name, sign in (("c", 1.0), ("d", -1.0)):
        rows = (folder / f"{name}.csv").read_text().splitlines()[1:]
        source = (folder / "c.csv").read_text().splitlines()[1:]
        pairs = zip(rows, source, strict=True)
        lines = [
            f"{row},{sign * float(of.split(',')[1])!r},{of.split(',')[1]}" for row, of in pairs
        ]
        (folder / f"{name}.csv").write_text("\n".join(["t (ms),x,F,counter,y,z", *lines]) + "\n")
    channels = [{"name": n, "column": n, "unit": "mm", "sd": 0.1} for n in ("y", "z")]
    runs = [
        {"name": "c", "file": "c.csv"},
        {"name": "d", "file": "d.csv", "use": "test"},
    ]
    _, out, _ = check(folder, capsys, channels=channels, runs=runs)
    assert "warning: run d: z is equal to the last digit to run c (use: fit)" in out
    assert "y is equal" not in out and "share" not in out
    _, out, _ = check(folder, capsys)
    assert "equal to the last digit" not in out


def test_one_recording_cannot_be_fitted_and_tested(folder, capsys):
    (folder / "d.csv").write_text((folder / "a.csv").read_text())
    code, out, _ = check(folder, capsys)
    assert code == 2
    assert "run d (use: test) and run a (use: fit) share 30 samples" in out


def test_a_study_without_a_model_is_read_all_the_same(folder, capsys):
    (folder / "study.yaml").write_text(
        yaml.safe_dump({**{k: v for k, v in BASE.items() if k != "model"}, "system": "rigid_body"})
    )
    assert cli.main(["diagnose", "check", str(folder / "study.yaml")]) == 0
    assert "warning: model: is missing" in capsys.readouterr().out


def test_a_described_published_set_is_found_by_its_name(folder, capsys, monkeypatch, tmp_path):
    described = tmp_path / "published"
    described.mkdir()
    text = yaml.safe_dump({**BASE, "data": str(folder), "runs": BASE["runs"]})
    (described / "my_rig.yaml").write_text(text)
    monkeypatch.setattr("diffsim.cli.arguments.PUBLISHED", described)
    assert cli.main(["diagnose", "check", "my_rig"]) == 0
    assert "rig: 4 runs" in capsys.readouterr().out
