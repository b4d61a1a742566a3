"""Files of strangers cannot read or write outside of their folder, nor show what is there.

Keys that name files are attacked in tests/test_stated_paths.py; here stand patterns, links, names,
files within files, and tables without end.
"""

import json
import os
import pickle
from pathlib import Path

import pytest
import torch

from diffsim.cli import main
from diffsim.copter.design.design_file import load_design
from diffsim.copter.exchange.mjcf_text import whole_mjcf, whole_scene
from diffsim.core.errors import MeshError
from diffsim.core.inside import inside, require_file_name
from diffsim.data import load_study
from diffsim.data.folder_tables import find_tables
from diffsim.data.formats import read_columns
from diffsim.data.table import open_table
from diffsim.identify.model_file import read_extended
from diffsim.learn.checkpoint import CHECKPOINT, read_checkpoint
from diffsim.learn.run import read_rows
from diffsim.mesh import load

SECRET = "time_s,secret,word\n0,1,hunter2\n1,2,hunter2\n"
STUDY = """
name: {name}
system: rigid_body
channels: [{{name: secret, unit: m}}]
runs: [{{name: a, file: {file!r}}}]
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


def test_files_in_the_folder_are_read(folder):
    (folder / "study.yaml").write_text(STUDY.format(name="cart", file="own.csv"))
    assert load_study(folder).runs[0].measured.shape == (2, 1)
    assert inside(folder, "sub/new.csv", "file") == folder / "sub" / "new.csv"


def test_links_of_the_user_may_lead_where_he_says(folder, monkeypatch, capsys):
    """A log of 10 GB is not copied; which links are his own, no file can say."""
    monkeypatch.setenv("DIFFSIM_LINKS", "")
    (folder / "study.yaml").write_text(STUDY.format(name="cart", file="link.csv"))
    (folder / "elsewhere").mkdir()
    for allowed in (None, folder / "elsewhere"):
        given = [] if allowed is None else ["--links", str(allowed)]
        assert main(["diagnose", "check", str(folder), *given]) == 2
        assert f"if the link is yours: --links {folder.parent}" in capsys.readouterr().err
    assert main(["diagnose", "check", str(folder), "--links", str(folder / "none")]) == 2
    assert "--links must be an existing folder" in capsys.readouterr().err
    main(["diagnose", "check", str(folder), "--links", str(folder.parent)])
    assert "is a link that leaves" not in capsys.readouterr().err
    assert load_study(folder).runs[0].measured.shape == (2, 1)
    for stated in ("../secret.csv", str(folder.parent / "secret.csv")):  # of the file, no link
        with pytest.raises(ValueError, match="folder"):
            inside(folder, stated, "file")


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


def test_what_no_text_can_hold_is_named(tmp_path):
    """Such a name was read, and ended what wrote it down."""
    time = [{"time_s": 0.1 * k, "q": k} for k in range(9)]
    for rows in ([{**r, "a\ud800": 1} for r in time], [{**r, "w": "\udc00b"} for r in time],
                 {"a\ud800": time, "b": time}):  # fmt: skip
        (tmp_path / "log.json").write_text(json.dumps(rows))
        with pytest.raises(ValueError, match=r"log.json: .* half of a character in"):
            read_columns(tmp_path / "log.json")
    (tmp_path / "log.json").unlink()
    for name in (b"a\xff.csv", b"b.csv"):
        Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name)).write_text("time_s,q\n0,1\n1,2\n")
    said: list[str] = []
    assert [table.path.name for table in find_tables(tmp_path, said)] == ["b.csv"]
    assert said == [r"not read: 'a\udcff.csv': no name of UTF-8 text; rename it"]


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


XML = """
<mujoco><compiler meshdir="."/><asset><mesh name="hull" file="{mesh}"/></asset><worldbody>
<body name="x"><freejoint/><geom type="mesh" mesh="hull" mass="1"/>
<include file="{include}"/></body></worldbody></mujoco>
"""
INNER = "<mujocoinclude><hunter2 name='hunter2'/></mujocoinclude>"


@pytest.mark.parametrize("read", [whole_mjcf, whole_scene])
@pytest.mark.parametrize("what", ["include", "mesh"])
@pytest.mark.parametrize("way", [0, 1, 3, 4, 8, 9])
def test_files_of_an_mjcf_stay_in_its_folder(folder, way, what, read):
    (folder.parent / "secret.csv").write_text(INNER)
    (folder / "own.xml").write_text("<mujocoinclude/>")
    (folder / "own.stl").write_bytes(bytes(84))
    named = {"include": "own.xml", "mesh": "own.stl"} | {what: outside(folder)[way]}
    (folder / "x.xml").write_text(XML.format(**named))
    with pytest.raises(ValueError, match=rf"file of <{what}> must .*folder") as refused:
        read(folder / "x.xml")
    assert "hunter2" not in str(refused.value)


def test_further_files_of_an_mjcf_are_not_read(folder):
    text = XML.format(mesh="own.stl", include="own.xml")
    (folder / "own.xml").write_text("<mujocoinclude><plugin file='own.csv'/></mujocoinclude>")
    (folder / "own.stl").write_bytes(bytes(84))
    (folder / "x.xml").write_text(text)
    with pytest.raises(ValueError, match="<plugin> reads another file"):
        whole_mjcf(folder / "x.xml")
    (folder / "own.xml").write_text("<mujocoinclude><include file='own.xml'/></mujocoinclude>")
    with pytest.raises(ValueError, match=r"'own\.xml' is included twice"):
        whole_mjcf(folder / "x.xml")


@pytest.mark.parametrize("read", [whole_mjcf, whole_scene])
@pytest.mark.parametrize(
    ("inside", "message"),
    [
        ('<replicate count="2000000000"><body/></replicate>', "count of <replicate> must be"),
        ('<replicate count="999"><replicate count="99"><geom/></replicate></replicate>',
         "makes 198,803 elements"),
        ('<replicate count="99"><body/><replicate count="99"><body/></replicate></replicate>',
         "makes 9,900 bodies"),
        ('<body name="b"><flexcomp name="f" count="90 90 90"/></body>', "count of <flexcomp>"),
        ('<body><composite count="9 9 99"/></body>', "count of <composite>"),
        ('<body/></worldbody><size nuser_body="2000000000"/><worldbody>', "nuser_body of <size>"),
        ('<body/></worldbody><size memory="9T"/><worldbody>', "memory of <size>"),
        ('<body/></worldbody><asset><hfield nrow="30000"/></asset><worldbody>', "nrow of <hfield>"),
        ("<body/>" * 3000, "makes 3,000 bodies"),
    ],
)  # fmt: skip
def test_what_an_mjcf_makes_is_counted(folder, read, inside, message):
    """MuJoCo takes 67 s for 10,000 bodies, and memory by the gigabyte for a few letters."""
    (folder / "x.xml").write_text(f"<mujoco><worldbody>{inside}</worldbody></mujoco>")
    with pytest.raises(ValueError, match=message):
        read(folder / "x.xml")


@pytest.mark.parametrize("line", ["*INCLUDE, INPUT={}", " * include,input = {}"])
def test_includes_of_abaqus_are_not_followed(folder, line):
    path = folder / "body.inp"
    path.write_text(f"*NODE\n1, 0, 0, 0\n{line.format(folder.parent / 'secret.csv')}\n")
    with pytest.raises(MeshError, match=r"body.inp includes another file") as refused:
        load(path)
    assert "hunter2" not in str(refused.value)


class Payload:
    """Runs code when it is loaded."""

    def __reduce__(self):
        return print, ("hunter2",)


def test_checkpoints_with_objects_are_refused_in_a_sentence(folder, capsys):
    for content in ({"setup": Payload()}, {"setup": "x"}, [1]):
        torch.save(content, folder / CHECKPOINT)
        with pytest.raises(ValueError, match=r"checkpoint.pt: (cannot be read|no checkpoint of)"):
            read_checkpoint(folder)
    (folder / CHECKPOINT).write_bytes(b"garbage")
    with pytest.raises(ValueError, match=r"checkpoint.pt: cannot be read as a checkpoint"):
        read_checkpoint(folder)
    assert "hunter2" not in capsys.readouterr().out


@pytest.mark.parametrize(
    "content", [b"garbage" * 50, b"PK\x03\x04" + bytes(99), b"", pickle.dumps(Payload())]
)
def test_controllers_that_are_none_are_refused_in_a_sentence(folder, capsys, content):
    (folder / "mine.npz").write_bytes(content)
    assert main(["play", "--file", str(folder / "mine.npz"), "--out", str(folder)]) == 2
    said = capsys.readouterr()
    assert "mine.npz: no controller that diffsim wrote" in said.err
    assert "hunter2" not in said.out


@pytest.mark.parametrize(
    "cut", ['{"rewa', "[" * 100_000, "[1]", '{"reward": 1}', "\ud800".encode("utf-8", "replace")]
)
def test_ratings_that_were_cut_name_their_row(folder, cut):
    rows = b'{"reward": null, "finished": false}\n' + (
        cut if isinstance(cut, bytes) else cut.encode()
    )
    (folder / "results.jsonl").write_bytes(rows)
    with pytest.raises(ValueError, match=r"results.jsonl, row 2: no rating of a training"):
        read_rows(folder)
