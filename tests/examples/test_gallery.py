"""The gallery: runs scripts, reads their numbers, keeps what is done."""

import json
import shutil

import pytest

from diffsim.cli import examples
from diffsim.core.errors import DiffsimError
from examples import gallery

SCRIPT = '''"""How far?"""
import sys
from pathlib import Path
if __name__ == "__main__":
    runs = Path(__file__).with_name("runs.txt")
    runs.write_text((runs.read_text() if runs.exists() else "") + "x")
    Path(sys.argv[1]).write_bytes(b"picture")
    print("travel m   12.3456")
    sys.exit({status})
'''
ENTRY = """
- title: A walk
  group: Walks
  example: walk
  options: ["{out}/walk.png"]
  picture: walk.png
  image: walked.png
  pattern: 'travel m\\s+(\\S+)'
  number: "{} m"
  thesis: "11 m"
"""


@pytest.fixture
def scripts(tmp_path, monkeypatch):
    folder = tmp_path / "examples"
    (folder / "walks").mkdir(parents=True)
    (folder / "walks/walk.py").write_text(SCRIPT.replace("{status}", "0"))
    (folder / "gallery.yaml").write_text(ENTRY)
    monkeypatch.setattr(gallery, "examples", lambda: examples.examples(folder))
    read = gallery.entries
    monkeypatch.setattr(gallery, "entries", lambda: read(folder / "gallery.yaml"))
    return folder


def test_page_has_picture_number_thesis_and_command(scripts, tmp_path):
    (tmp_path / "docs/images").mkdir(parents=True)
    results = gallery.make(tmp_path / "out", docs=tmp_path / "docs")
    gallery.require_success(results)
    page = (tmp_path / "docs/gallery.md").read_text()
    for part in ("## Walks", "![A walk](images/walked.png)", "**12.3 m**", "Thesis: 11 m", "walk"):
        assert part in page
    assert (tmp_path / "docs/images/walked.png").read_bytes() == b"picture"


def test_one_entry_anew_leaves_the_others_on_the_page(scripts, tmp_path):
    docs, again = tmp_path / "docs", ENTRY.replace("A walk", "Again").replace("walked", "again")
    (docs / "images").mkdir(parents=True)
    (scripts / "gallery.yaml").write_text(ENTRY + again)
    gallery.make(tmp_path / "out", ["walked"], docs)
    assert "Again" not in (docs / "gallery.md").read_text()
    shutil.rmtree(tmp_path / "out")
    results = gallery.make(tmp_path / "out", ["again"], docs)
    assert [r["key"] for r in results] == ["walked", "again"]
    assert (docs / "gallery.md").read_text().count("**12.3 m**") == 2
    assert (scripts / "walks/runs.txt").read_text() == "xx"


def test_result_is_kept_until_the_script_changes(scripts, tmp_path):
    runs = scripts / "walks/runs.txt"
    gallery.make(tmp_path / "out")
    gallery.make(tmp_path / "out")
    assert runs.read_text() == "x"
    script = scripts / "walks/walk.py"
    script.write_text(script.read_text() + "\n")
    gallery.make(tmp_path / "out")
    assert runs.read_text() == "xx"


def test_failure_is_on_the_page_and_raised(scripts, tmp_path):
    (scripts / "walks/walk.py").write_text(SCRIPT.replace("{status}", "3"))
    results = gallery.make(tmp_path / "out")
    assert "failed: exit status 3" in (tmp_path / "out/gallery.md").read_text()
    with pytest.raises(DiffsimError, match="walked: exit status 3"):
        gallery.require_success(results)


def test_number_that_is_not_printed_is_a_failure(scripts, tmp_path):
    (scripts / "gallery.yaml").write_text(ENTRY.replace("travel m", "height m"))
    (result,) = gallery.make(tmp_path / "out")
    assert "no line like 'height" in result["failure"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("example: walk", "example: wall"), "walk"),
        (("thesis:", "theses:"), "A walk.*theses"),
        (('thesis: "11 m"', "color: red"), "color"),
    ],
)
def test_bad_entries_are_named(scripts, change, message):
    (scripts / "gallery.yaml").write_text(ENTRY.replace(*change))
    with pytest.raises(ValueError, match=message):
        gallery.entries()


def test_shipped_entries_are_well_formed():
    found = gallery.entries()
    assert len({e.key for e in found}) == len(found) > 5


@pytest.mark.parametrize("entry", [e for e in gallery.entries() if e.page], ids=lambda e: e.key)
def test_what_the_gallery_quotes_of_a_page_stands_there(entry):
    found = gallery._from_page(entry)
    assert not found["failure"]
    assert (gallery.DOCS / "images" / entry.image).is_file()


def test_table_of_refined_results_follows_the_pictures(scripts, tmp_path, monkeypatch):
    docs = tmp_path / "docs"
    (docs / "images").mkdir(parents=True)
    values = {"as made": 449.0, "step / 2": 461.3}
    row = {"quantity": "travel [mm]", "values": values}
    other = {"quantity": "speed [mm/s]", "values": {"as made": 5.9}}
    (docs / gallery.REFINED).write_text(json.dumps({"walk": row, "swim": other}))
    monkeypatch.setattr(gallery, "DOCS", docs)
    gallery.make(tmp_path / "out", docs=docs)
    page = (docs / "gallery.md").read_text()
    assert "| walk | travel [mm] | 449 | 461 |" in page
    assert "| swim | speed [mm/s] | 5.9 | not run |" in page
    assert page.index("A walk") < page.index("## Under refinement")
