"""``diffsim diagnose faults``: groups of a study, and recordings that are not in it."""

import json

import numpy as np
import pytest

from diffsim.cli.diagnose_faults import with_new
from diffsim.cli.main import main

STUDY = """\
name: pair
model:
  system: bench
  parameters: {
    level: {value: 1, percent: 10, per: rig},
    gain_1: {value: 1, sd: 0.02, per: day}, gain_2: {value: 1, sd: 0.02, per: day}}
  define: {left: level/gain_1, right: level/gain_2}
  readings: {y1: left, y2: right}
  effects:
    own:
      - {name: weak_1, multiplies: left, term: 1/(1 - size), typical: 0.1, one_sided: true,
         words: "side 1 lost {:.0%}"}
      - {name: weak_2, multiplies: right, term: 1/(1 - size), typical: 0.1, one_sided: true}
channels: [{name: y1, unit: "-", sd: 0.01}, {name: y2, unit: "-", sd: 0.01}]
faults:
  per: day
  scatter: [[gain_1, gain_2]]
  known: {fact: done, causes: {nothing: [], cut: weak_1}}
defaults: {setup: {rig: A}}
runs:
  - {file: "sound{n}.csv", setup: {day: "{n}", done: nothing}}
  - {file: "cut{n}.csv", setup: {day: "cut{n}", done: cut}}
"""


def write(path, rng, factor=(1.0, 1.0)):
    level = np.array(factor) * (1.0 + 0.01 * rng.standard_normal(2))
    rows = level + 0.01 * rng.standard_normal((8, 2))
    body = "\n".join(f"{0.1 * i:g},{a:.5f},{b:.5f}" for i, (a, b) in enumerate(rows))
    path.write_text(f"time_s,y1,y2\n{body}\n")


@pytest.fixture
def folder(tmp_path):
    rng = np.random.default_rng(0)
    for n in range(8):
        write(tmp_path / f"sound{n}.csv", rng)
    for n in range(2):
        write(tmp_path / f"cut{n}.csv", rng, (1.2, 1.0))
    new = tmp_path / "new"
    new.mkdir()
    write(new / "weak.csv", rng, (1.25, 1.0))
    write(new / "sound.csv", rng)
    (tmp_path / "study.yaml").write_text(STUDY)
    return tmp_path


def run(folder, *more):
    out = folder / "out"
    assert main(["diagnose", "faults", str(folder), "--out", str(out), *map(str, more)]) == 0
    return {v["group"]: v for v in json.loads((out / "faults.json").read_text())["verdicts"]}


def test_new_recordings_are_groups_of_their_own(folder, capsys):
    new = folder / "new"
    said = run(folder, "--new", new / "weak.csv", "--new", new / "sound.csv", "--fact", "rig=A")
    assert {k: v["causes"] for k, v in said.items()} == {"new_1": ["weak_1"], "new_2": []}
    size = said["new_1"]["sizes"][0]["interval"]
    assert size["low"] < 0.2 < size["high"] < 0.3
    out = capsys.readouterr().out
    assert "1 of 2 groups has a fault, new_1 (weak.csv): side 1 lost " in out
    assert "Side 1 lost " in (folder / "out" / "faults.html").read_text("utf-8")
    assert "Nothing visible beyond the scatter between groups." in out


def test_verdicts_name_the_files_and_facts_of_each_group(folder, capsys):
    """Of 32 recordings the verdicts were called new_1 to new_32."""
    text = STUDY.replace("setup: {rig: A}", "setup: {rig: A, place: hall}")
    (folder / "study.yaml").write_text(text)
    new = folder / "new"
    given = ["--new", new / "weak.csv", "--new", new / "sound.csv"]
    said = run(folder, *given, "--fact", "new_2:place=yard")
    assert said["new_1"]["facts"] == {"rig": "A", "place": "hall"}
    assert said["new_2"]["facts"] == {"rig": "A", "place": "yard"}
    assert said["new_2"]["runs"] == ["new_2 sound"]
    lines = capsys.readouterr().out.splitlines()
    place = next(i for i, line in enumerate(lines) if line.startswith("new_2"))
    assert lines[place + 1] == "  run sound; rig A; place yard"
    out = ["--out", str(folder / "out")]
    wrong = ["--fact", "new_3:place=yard"]
    assert main(["diagnose", "faults", str(folder), *out, *map(str, given), *wrong]) != 0
    assert "new_3" in capsys.readouterr().err


def test_a_program_finds_the_verdict_of_a_file(folder):
    new = folder / "new"
    write(folder / "sound.csv", np.random.default_rng(1))
    given = ["--new", new / "weak.csv", "--new", new / "sound.csv", folder / "sound.csv"]
    said = run(
        folder, *given, "--fact", "weak.csv:place=yard", "--fact", f"{new}/sound.csv:place=hall"
    )
    report = json.loads((folder / "out" / "faults.json").read_text())
    files = {str(new / "weak.csv"): "new_1", str(new / "sound.csv"): "new_2"}
    assert report["groups_of_file"] == {
        **{file: [group] for file, group in files.items()},
        str(folder / "sound.csv"): ["new_2"],
    }
    assert said["new_2"]["runs"] == ["new_2 sound", "new_2 sound_2"]
    assert said["new_1"]["files"] == [str(new / "weak.csv")]
    assert [said[g]["facts"]["place"] for g in ("new_1", "new_2")] == ["yard", "hall"]


def test_a_name_that_two_groups_have_is_no_address(folder, capsys):
    write(folder / "weak.csv", np.random.default_rng(1))
    given = ["--new", folder / "new" / "weak.csv", "--new", folder / "weak.csv"]
    out = ["--out", folder / "out", "--fact", "weak.csv:place=yard"]
    assert main(["diagnose", "faults", *map(str, [folder, *given, *out])]) != 0
    assert "weak.csv" in capsys.readouterr().err


def test_new_recordings_are_never_for_fitting(folder):
    files = [[folder / "new" / "weak.csv"], [folder / "new" / "sound.csv"]]
    study = with_new(str(folder), files, {"rig": "A"})
    assert {r.name: r.use for r in study.runs if r.name.startswith("new")} == {
        "new_1 weak": "test",
        "new_2 sound": "test",
    }


@pytest.mark.story  # ten groups, each judged alone
def test_known_groups_are_judged_by_the_others(folder, capsys):
    said = run(folder, "--all")
    assert len(said) == 10
    assert {k for k, v in said.items() if v["causes"]} == {"cut0", "cut1"}
    assert "10 of 10 groups with a known change are named exactly." in capsys.readouterr().out


def test_explain_judges_every_group(folder, capsys):
    assert main(["diagnose", "explain", str(folder), "--out", str(folder / "out")]) == 0
    assert "cut1 (said: cut): " in capsys.readouterr().out


def test_what_is_missing_is_said(folder, capsys):
    new = folder / "new" / "weak.csv"
    (folder / "study.yaml").write_text(
        STUDY.replace("defaults: {setup: {rig: A}}\n", "").replace("{day", "{rig: A, day")
    )
    assert main(["diagnose", "faults", str(folder), "--new", str(new)]) != 0
    assert "model.parameters.level: per: run new weak" in capsys.readouterr().out
    bare = STUDY[: STUDY.index("faults:")] + STUDY[STUDY.index("defaults:") :]
    (folder / "study.yaml").write_text(bare)
    assert main(["diagnose", "faults", str(folder)]) != 0
    assert "has no `faults`" in capsys.readouterr().err


def test_check_finds_names_that_there_are_not(folder, capsys):
    (folder / "study.yaml").write_text(STUDY.replace("[[gain_1, gain_2]]", "[[gain_1, gain_3]]"))
    assert main(["diagnose", "check", str(folder)]) != 0
    assert "faults.scatter[0]: no fitted quantity 'gain_3'" in capsys.readouterr().out


def test_a_faulty_record_is_blamed_before_any_group(folder, capsys):
    for path in folder.glob("sound*.csv"):
        header, *lines = path.read_text().splitlines()
        lines[3] = lines[3].rsplit(",", 1)[0] + ",-16000"
        path.write_text("\n".join([header, *lines]) + "\n")
    study = folder / "study.yaml"
    assert main(["diagnose", "faults", str(study), "--out", str(folder / "out")]) == 0
    said = capsys.readouterr().out
    assert "verdict: record" in said and "weak" not in said
    report = json.loads((folder / "out" / "report.json").read_text())
    assert report["verdict"] == "record" and not (folder / "out" / "faults.json").exists()
