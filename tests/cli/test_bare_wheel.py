"""Commands that need no extra run without any; published data is verified, or asked for."""

import hashlib
import subprocess
import sys
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import pytest
import yaml

from diffsim.cli import main
from diffsim.data import published_sets
from diffsim.data.published_sets import TABLE, PublishedSet, differing

# what a bare wheel does not bring: imports fail, and so does the search for them
WITHOUT = """
import importlib.util, sys
LACKS = {"matplotlib", "jinja2", "plotly", "gymnasium", "stable_baselines3", "rerun", "mujoco"}
class Lacking:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in LACKS:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Lacking())
found = importlib.util.find_spec
importlib.util.find_spec = lambda n, p=None: None if n in LACKS else found(n, p)
from diffsim.cli import main
sys.exit(main(["play"]) or main(["fabricate", "pentacopter", "--out", "plan"]))
"""


@pytest.mark.story  # a whole plan, in a process of its own
def test_play_lists_and_fabricate_plans_without_any_extra(tmp_path):
    made = subprocess.run(
        [sys.executable, "-c", WITHOUT], capture_output=True, text=True, cwd=tmp_path
    )
    assert made.returncode == 0, made.stderr
    said = made.stdout
    assert "CopterHover" in said
    assert "no page with pictures: pip install" in said and "plan: plan" in said
    assert (tmp_path / "plan/rods.csv").is_file() and not (tmp_path / "plan/index.html").exists()


CONTENT = {"metadata.yaml": b"name: toy\n", "run.csv": b"time_s,x\n0,1\n"}


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """A published set of two files, offered in a folder."""
    offered = tmp_path / "offered/toy"
    offered.mkdir(parents=True)
    for name, content in CONTENT.items():
        (offered / name).write_bytes(content)
    sums = {n: (hashlib.sha256(c).hexdigest(), len(c)) for n, c in CONTENT.items()}
    known = PublishedSet(
        name="toy", source="https://example.org/toy", commit="1a2b", licence="MIT", files=sums
    )
    monkeypatch.setattr(published_sets, "published_sets", lambda: {"toy": known})
    monkeypatch.setenv("DIFFSIM_DATA", str(tmp_path / "here"))
    return offered


def test_a_published_set_is_fetched_and_verified(toy, tmp_path, capsys):
    here = tmp_path / "here/toy"
    assert main(["data", "get", "toy"]) == 2  # not here, and nobody said from where
    assert "--from ADDRESS" in capsys.readouterr().err
    assert main(["data", "get", "toy", "--from", str(toy.parent)]) == 0
    said = capsys.readouterr().out
    assert "https://example.org/toy, commit 1a2b" in said and "Licence: MIT" in said
    assert {p.name: p.read_bytes() for p in here.iterdir()} == CONTENT
    (here / "run.csv").write_bytes(b"time_s,x\n0,2\n")
    assert main(["data", "get", "toy"]) == 2
    assert "run.csv is missing or another file" in capsys.readouterr().err
    (toy / "run.csv").write_bytes(b"time_s,x\n0,3\n")  # so is what is offered
    assert main(["data", "get", "toy", "--from", str(toy.parent)]) == 2
    assert "is not the file of this study" in capsys.readouterr().err
    assert (here / "run.csv").read_bytes() == b"time_s,x\n0,2\n"


def test_a_published_set_comes_over_http_and_says_when_nobody_answers(toy, tmp_path, capsys):
    class Offer(SimpleHTTPRequestHandler):
        def __init__(self, *args):
            super().__init__(*args, directory=str(toy.parent))

        def log_message(self, *args):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Offer)
    address = f"http://127.0.0.1:{server.server_port}"
    Thread(target=server.serve_forever, daemon=True).start()
    try:
        assert main(["data", "get", "toy", "--from", address]) == 0
    finally:
        server.shutdown()
        server.server_close()
    capsys.readouterr()
    (tmp_path / "here/toy/run.csv").unlink()
    assert main(["data", "get", "toy", "--from", address]) == 2
    assert "cannot be read" in capsys.readouterr().err


def test_every_published_study_has_a_described_data_set():
    from importlib.resources import files

    known = published_sets.published_sets()
    studies = (files("diffsim.systems") / "published").iterdir()
    asked = {yaml.safe_load(p.read_text()).get("data") for p in studies if p.name.endswith(".yaml")}
    assert asked - {None} == set(known)
    for one in known.values():
        assert one.source.startswith("https://") and one.licence and one.files
        assert all(len(digest) == 64 and size > 0 for digest, size in one.files.values())
    assert (files("diffsim.data") / TABLE).is_file()


@pytest.mark.parametrize("name", ["emps", "starfish"])
def test_the_described_sums_are_those_of_the_data(name):
    from tests.measured import data_folder

    assert differing(published_sets.published_set(name), data_folder(name)) == []
