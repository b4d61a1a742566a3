"""What the docs show runs as it stands there, and their links lead somewhere."""

import re
import shlex
from pathlib import Path

import pytest

from diffsim.cli import main

ROOT = Path(__file__).resolve().parents[2]
PAGES = (
    "README.md",
    "docs/applications.md",
    "docs/benchmarks.md",
    "docs/concepts.md",
    "docs/contact.md",
    "docs/copter.md",
    "docs/ode.md",
    "docs/optim.md",
    "docs/own_causes.md",
    "docs/soft.md",
    "docs/stokes.md",
    "docs/transformations.md",
)
SHORTER = {
    "README.md": {"rest_state(), 400": "rest_state(), 40"},
    "docs/copter.md": {
        'load_mission("carry"))': 'load_mission("carry"), seconds=0.5)',
        "num_starts=8": "num_starts=1",
        "Budget(50)": "Budget(3)",
        'design, "payload", limits=Limits(clearance=0.01))': (
            'design, "payload", limits=Limits(clearance=0.01), search=SearchOptions(num_starts=1))'
        ),
        "plan(design, best.s, best.directions, best.spins)": "plan(load_design('quadcopter'))",
    },
}
"""What is replaced in dear pages: shorter flights, fewer starts; the same calls."""
LONG = ("diffsim diagnose explain", "diffsim diagnose judge", "diffsim diagnose next")
LINKED = ("README.md", "examples/*.md", "docs/**/*.md")


def run(text, page):
    """Block after block, as a reader would paste them."""
    blocks = re.findall(r"```python\n(.*?)```", text, re.S)
    names = {"__name__": "__main__"}
    for i, code in enumerate(blocks):
        exec(compile(code, f"{page}, block {i + 1}", "exec"), names)
    assert blocks


@pytest.mark.story  # pages
@pytest.mark.example
@pytest.mark.parametrize("page", PAGES)
def test_its_python_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = (ROOT / page).read_text(encoding="utf-8")
    for long, short in SHORTER.get(page, {}).items():
        assert long in text
        text = text.replace(long, short)
    run(text, page)


@pytest.mark.example
@pytest.mark.parametrize(
    "whole",
    [
        pytest.param(
            False, marks=pytest.mark.short_of("test_a_diagnosis_from_its_pages_alone[True]")
        ),
        pytest.param(True, marks=pytest.mark.story),
    ],
)
def test_a_diagnosis_from_its_pages_alone(whole, tmp_path, monkeypatch, capsys):
    """Python, ``study.yaml`` and commands of a first answer, then of its use, in an empty folder.

    In short: all but the commands that simulate.
    """
    monkeypatch.chdir(tmp_path)
    pages = [ROOT / "docs" / name for name in ("diagnose.md", "diagnose_using.md")]
    page = "".join(path.read_text(encoding="utf-8") for path in pages)
    names = {"__name__": "__main__"}
    for kind, text in re.findall(r"```(python|yaml|sh)\n(.*?)```", page, re.S):
        if kind == "python":
            exec(compile(text, "docs/diagnose.md", "exec"), names)
        elif kind == "yaml" and text.startswith("# cart/study.yaml"):
            Path("cart/study.yaml").write_text(text)
        elif kind == "sh":
            for line in text.strip().splitlines():
                if not whole and line.startswith(LONG):
                    continue
                assert main(shlex.split(line.removeprefix("diffsim "), comments=True)) == 0
    certain = {c.name for c in names["report"].causes if c.status == "certain"}
    assert certain == {"dry_friction"}
    if not whole:
        return
    said = _words(capsys.readouterr().out)
    shown = re.search(r"after ten seconds:(.*)", page, re.S).group(1)
    blocks = re.findall(r"```text\n(.*?)```", shown, re.S)
    assert len(blocks) == 3  # of explain, judge and next
    for line in "".join(blocks).splitlines():
        assert _words(line) in said  # the page shows what is printed


def _words(text: str) -> str:
    """Last digits differ between processors."""
    return re.sub(r"[\d.]+", "#", text)


def test_links_lead_somewhere():
    missing = []
    for page in (path for pattern in LINKED for path in ROOT.glob(pattern)):
        text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)  # no code
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
            if "://" not in target and not (page.parent / target).exists():
                missing.append(f"{page.relative_to(ROOT)}: {target}")
    assert not missing
