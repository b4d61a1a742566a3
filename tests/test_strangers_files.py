"""Files of strangers cannot read or write outside of their folder, nor show what is there."""

from pathlib import Path

import pytest

from diffsim.copter.design.design_file import load_design
from diffsim.core.inside import inside, require_file_name
from diffsim.data import load_study
from diffsim.data.table import open_table
from diffsim.identify.model_file import read_extended

SECRET = "time_s,secret\n0,hunter2\n1,hunter2\n"
STUDY = """
name: {name}
system: rigid_body
channels: [{{name: secret, unit: m}}]
runs: [{{name: a, file: {file!r}}}]
"""
DESIGN = """
parts:
  frame: {{kind: mesh_frame,
    file: {file!r}, mounts: {{nose: {{center: [0, 0, 0], normal: [0, 0, -1]}}}}}}
"""


@pytest.fixture
def folder(tmp_path):
    """A stranger's folder; beside it a file that is none of his business."""
    (tmp_path / "secret.csv").write_text(SECRET)
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "link.csv").symlink_to(tmp_path / "secret.csv")
    (tmp_path / "theirs" / "up").symlink_to(tmp_path)
    (tmp_path / "theirs" / "own.csv").write_text("time_s,secret\n0,1\n1,2\n")
    return tmp_path / "theirs"


def outside(folder: Path) -> list[str]:
    """Ways out of a folder."""
    return [
        str(folder.parent / "secret.csv"),
        "../secret.csv",
        "sub/../../secret.csv",
        "link.csv",
        "up/secret.csv",
        "../*.csv",
        "l*.csv",
        "u{word}/secret.csv",
        r"..\secret.csv",
        r"C:\secret.csv",
    ]


@pytest.mark.parametrize("way", range(10))
def test_runs_stay_in_their_folder(folder, way):
    study = folder / "study.yaml"
    study.write_text(STUDY.format(name="cart", file=outside(folder)[way]))
    with pytest.raises(ValueError, match=r"runs\[0\].file") as refused:
        load_study(study)
    assert "hunter2" not in str(refused.value)


@pytest.mark.parametrize("way", [0, 1, 3, 4, 8, 9])
def test_parts_of_designs_stay_in_their_folder(folder, way):
    path = folder / "copter.yaml"
    path.write_text(DESIGN.format(file=outside(folder)[way]))
    with pytest.raises(ValueError, match=r"copter.yaml: parts.frame: file .*folder"):
        load_design(path)


def test_files_in_the_folder_are_read(folder):
    (folder / "study.yaml").write_text(STUDY.format(name="cart", file="own.csv"))
    assert load_study(folder).runs[0].measured.shape == (2, 1)
    assert inside(folder, "sub/new.csv", "file") == folder / "sub" / "new.csv"


def test_files_that_the_caller_names_may_lie_anywhere(folder):
    (folder / "study.yaml").write_text(STUDY.format(name="cart", file="own.csv"))
    new = {"name": "new", "file": str(folder.parent / "secret.csv").replace("secret", "new")}
    (folder.parent / "new.csv").write_text("time_s,secret\n0,1\n1,2\n")
    assert [run.name for run in load_study(folder, [new]).runs] == ["a", "new"]


@pytest.mark.parametrize("name", ["../../home", "/etc", "a/b", "..", "", "a\\b", "x" * 300])
def test_names_that_would_be_paths_are_refused(folder, name):
    (folder / "study.yaml").write_text(STUDY.format(name=repr(name), file="own.csv"))
    with pytest.raises(ValueError, match=r"study.yaml: name"):
        load_study(folder)
    (folder / "copter.yaml").write_text(f"name: {name!r}\nparts: {{motor: {{kind: motor}}}}\n")
    with pytest.raises(ValueError, match=r"copter.yaml: name: name must"):
        load_design(folder / "copter.yaml")
    with pytest.raises(ValueError, match="name must"):
        require_file_name("name", name)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            ",".join(f"c{i}" for i in range(200_000)) + "\n1\n",
            r"row 1: .*10,000 columns, got 200,000",
        ),
        ("x" * 5_000_000, r"row 1: .*4,000,000 letters"),
        ('time_s,a\n0,1\n1,"' + "x" * 200_000 + '"\n', r"row 3: not CSV: field larger"),
    ],
    ids=["columns", "letters", "field"],
)
def test_tables_without_end_are_refused_at_once(tmp_path, content, message):
    path = tmp_path / "wide.csv"
    path.write_text(content)
    with pytest.raises(ValueError, match=message), open_table(path, "run") as (_, rows):
        list(rows)


MODEL = "verdict: named\nparameters:\n  k: {value: 1.0, sd: 0.1, unit: N}\neffects: {}\n"


@pytest.mark.parametrize(
    ("good", "bad", "message"),
    [
        ("value: 1.0", "value: .nan", r"k: value must lie in .*got nan"),
        ("value: 1.0", "value: .inf", r"k: value must lie in .*got inf"),
        ("value: 1.0", "value: true", r"k: value must be a number, got bool"),
        ("sd: 0.1", "sd: -0.1", r"k: sd must lie in \[0, inf\), got -0.1"),
        ("sd: 0.1", "sd: .nan", r"k: sd must lie in .*got nan"),
        ("sd: 0.1", "sd: .inf", r"k: sd must lie in .*got inf"),
        ("effects: {}", "effects: {}\nnumerics: {steps: 2}", r"numerics must be one of .*'steps'"),
        ("effects: {}", "effects: {}\nnumerics: {mesh: 0}", r"numerics.mesh must lie in \(0, inf"),
        ("effects: {}", "effects: {}\nprepared_at: {k: .nan}", r"prepared_at.k: value must lie"),
        ("effects: {}", "effects: {}\nfacts: [1]", r"facts must be a mapping, got list"),
    ],
)
def test_saved_models_hold_numbers(tmp_path, good, bad, message):
    path = tmp_path / "extended_model.yaml"
    path.write_text(MODEL)
    assert read_extended(path).values == {"k": 1.0}
    path.write_text(MODEL.replace(good, bad))
    with pytest.raises(ValueError, match=r"extended_model.yaml: " + message):
        read_extended(path)
