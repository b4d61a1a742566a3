"""What the docs show runs as it stands there, and their links lead somewhere."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = (
    "README.md",
    "docs/applications.md",
    "docs/benchmarks.md",
    "docs/concepts.md",
    "docs/contact.md",
    "docs/copter.md",
    "docs/diagnose.md",
    "docs/ode.md",
    "docs/optim.md",
    "docs/soft.md",
    "docs/stokes.md",
)
LINKED = ("README.md", "examples/*.md", "docs/**/*.md")


@pytest.mark.example
@pytest.mark.parametrize("page", PAGES)
def test_its_python_runs(page, tmp_path, monkeypatch):
    """Block after block, as a reader would paste them."""
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.S)
    names = {"__name__": "__main__"}
    for i, code in enumerate(blocks):
        exec(compile(code, f"{page}, block {i + 1}", "exec"), names)
    assert blocks


def test_links_lead_somewhere():
    missing = []
    for page in (path for pattern in LINKED for path in ROOT.glob(pattern)):
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
            if "://" not in target and not (page.parent / target).exists():
                missing.append(f"{page.relative_to(ROOT)}: {target}")
    assert not missing
