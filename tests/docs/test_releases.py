"""Releases: the version stands in one place, and what changed is told in lines that can be read."""

import re
from pathlib import Path

import pytest

from diffsim import __version__

ROOT = Path(__file__).resolve().parents[2]
HEADINGS = ["Added", "Changed", "Deprecated", "Removed", "Fixed"]
MOST_ENTRIES = 40  # of a release
LONGEST = 120  # letters of an entry: symbol, effect for the user, page
LONGEST_NUMERICS = 240  # with old value, new value and reason
ENDS = (".toml", ".cff", ".yml", ".yaml", ".py", ".md", ".cfg", "")
TELL_OF_RELEASES = ("CHANGELOG.md", "docs/numerics.md")


def sections(text: str) -> dict[str, list[str]]:
    """Lines of each release, by its heading."""
    parts = re.split(r"^## (.+)\n", text, flags=re.M)[1:]
    return {name: body.splitlines() for name, body in zip(parts[::2], parts[1::2], strict=True)}


def misplaced(text: str) -> list[str]:
    """Lines of a changelog that are too long, go on from another line, or stand out of order."""
    found = []
    for release, lines in sections(text).items():
        headings = [line[4:] for line in lines if line.startswith("### ")]
        if headings != [name for name in HEADINGS if name in headings]:
            found.append(f"{release}: {headings}")
        for line in lines:
            is_known = re.match(r"(- \S|### |\[[^\]]+\]: \S|$)", line)
            if not is_known or len(line) > LONGEST:
                found.append(f"{release}: {line}")
    return found


def entries(lines: list[str]) -> list[str]:
    """Entries that may go on in indented lines, each as one line."""
    return re.findall(r"^- .+", re.sub(r"\n +", " ", "\n".join(lines)), re.M)


def statements(version: str, root: Path) -> list[str]:
    """Places that state the version, or a version of their own, of what users get."""
    places = [*root.glob("*"), *(root / ".github").rglob("*"), *(root / "scripts").rglob("*")]
    places += [*(root / "diffsim").rglob("*"), *(root / "docs").rglob("*")]
    own = re.compile(r"^(?:__version__|version)\b\s*[:=]\s*[\"']?\d", re.M)
    literal = re.compile(rf"(?<![\w.=]){re.escape(version)}(?!\.?\d)")
    found = []
    for path in sorted(p for p in places if p.suffix in ENDS and p.is_file()):
        name = path.relative_to(root).as_posix()
        text = path.read_text(encoding="utf-8", errors="replace")
        if name not in TELL_OF_RELEASES and (own.search(text) or literal.search(text)):
            found.append(name)
    return found


def test_the_version_is_stated_once(tmp_path):
    assert statements(__version__, ROOT) == ["diffsim/core/version.py"]
    (tmp_path / "CITATION.cff").write_text("type: software\nversion: 0.1.0\n")
    (tmp_path / "README.md").write_text(f"This is diffsim {__version__}.\n")
    (tmp_path / "pyproject.toml").write_text(f"other=={__version__}\n")  # of another package
    assert statements(__version__, tmp_path) == ["CITATION.cff", "README.md"]


def test_a_distribution_has_the_stated_version():
    tables = pytest.importorskip("setuptools.config.pyprojecttoml", reason="scripts/setup has it")
    project = tables.read_configuration(ROOT / "pyproject.toml", expand=True)["project"]
    assert project["version"] == __version__


def test_releases_go_from_new_to_old():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    first, *released = sections(text)
    found = [re.fullmatch(r"\[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d)", name) for name in released]
    assert first == "[Unreleased]" and all(found), released
    versions = [tuple(map(int, match[1].split("."))) for match in found]
    dates = [match[2] for match in found]
    assert versions == sorted(set(versions), reverse=True)
    assert dates == sorted(dates, reverse=True)
    assert found[0][1] == __version__
    numerics = (ROOT / "docs" / "numerics.md").read_text(encoding="utf-8")
    assert list(sections(numerics)) == ["Unreleased", *(match[1] for match in found)]


def test_entries_of_the_changelog_are_short_lines_in_order():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert misplaced(text) == []
    unreleased, *released = sections(text).values()
    assert max(len(entries(lines)) for lines in released) <= MOST_ENTRIES
    assert [line[4:] for line in unreleased if line.startswith("### ")] == HEADINGS
    assert misplaced("## 1\n### Fixed\n- a\n### Added\n- b\n") == ["1: ['Fixed', 'Added']"]
    assert misplaced(f"## 1\n### News\n- {'a' * 119}\n  goes on\n") == [
        "1: ['News']",
        f"1: - {'a' * 119}",
        "1:   goes on",
    ]


def test_pages_that_the_changelog_names_are_there():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    pages = dict(re.findall(r"^\[([^\]]+)\]: (\S+)$", text, re.M))
    named = set(re.findall(r"^[^#\n].* \[([^\]]+)\]\.?$", text, re.M))
    assert named == set(pages)
    assert [page for page in pages.values() if not (ROOT / page).is_file()] == []


def test_entries_of_numerics_are_short():
    pages = (ROOT / "docs" / "numerics.md", ROOT / "studies" / "records" / "numerics.md")
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    found = [entry[2:] for lines in sections(text).values() for entry in entries(lines)]
    assert len(found) > 50  # the pattern reads them
    assert [entry for entry in found if len(entry) > LONGEST_NUMERICS] == []
    assert [line for line in text.splitlines() if len(line) > LONGEST] == []
    assert entries(["- a", "  b", "- c"]) == ["- a b", "- c"]
