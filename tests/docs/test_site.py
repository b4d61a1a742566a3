"""The site: every page has its place, it builds without a warning, and a browser finds things."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]


def test_every_page_is_in_the_navigation():
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    named = set(re.findall(r"[\w/.]+\.md", str(yaml.safe_load(text)["nav"])))
    pages = {p.relative_to(ROOT / "docs").as_posix() for p in (ROOT / "docs").rglob("*.md")}
    pages |= {
        p.relative_to(ROOT / "docs").with_suffix(".md").as_posix()
        for p in (ROOT / "docs").rglob("*.ipynb")
    }
    by_hook = {p for p in pages if p.startswith("measured/") and p != "measured/README.md"}
    assert named - {"changelog.md", "contributing.md"} == pages - by_hook


def test_links_and_roles_of_the_site(tmp_path):
    pytest.importorskip("mkdocs", reason="scripts/docs installs it")
    sys.path.insert(0, str(ROOT / "scripts"))
    try:
        import docs_site
    finally:
        sys.path.pop(0)
    assert "soft" in docs_site.rooms() and "core" in docs_site.rooms()
    html = docs_site.on_page_content("see :class:<code>~diffsim.soft.Muscle</code>.")
    assert html == (
        'see <autoref identifier="diffsim.soft.Muscle" optional><code>Muscle</code></autoref>.'
    )
    text = docs_site.notebook(ROOT / "docs" / "tutorials" / "1_own_shape.ipynb")
    assert text.startswith("# ") and "```python\nimport trimesh" in text
    assert docs_site._parts("0.10.1") > docs_site._parts("0.9")


def test_kernels_are_read_from_their_sources_and_never_loaded():
    """Looking into the kernels of a newer processor ends the build: "Illegal instruction"."""
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    plugins = yaml.safe_load(text)["plugins"]
    (docstrings,) = (p["mkdocstrings"] for p in plugins if "mkdocstrings" in p)
    assert docstrings["handlers"]["python"]["options"]["allow_inspection"] is False


def test_the_pages_keep_to_their_words():
    """90 thousand words stand between a newcomer and an answer; what a script writes counts apart.

    Records of trials belong in ``studies/records``.
    """
    words = 0
    for page in (ROOT / "docs").rglob("*.md"):
        if page.parent.name != "environments":  # which scripts/environment_pages.py writes
            text = page.read_text(encoding="utf-8").partition("<!-- Below this line: written")[0]
            text = re.sub(r"<!-- (\w+): written.*?<!-- end of \1 -->", "", text, flags=re.DOTALL)
            words += len(text.split())
    assert words <= 90_000


@pytest.mark.slow
def test_it_builds_without_a_warning(tmp_path):
    pytest.importorskip("mkdocstrings", reason="scripts/docs installs it")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "WARNING" not in done.stderr.replace("NO_MKDOCS_2_WARNING", "")
    page = (tmp_path / "reference" / "soft.html").read_text(encoding="utf-8")
    assert 'id="diffsim.soft.SoftBody"' in page and ":class:" not in page
    assert "load_regions" in (tmp_path / "search" / "search_index.json").read_text(encoding="utf-8")
    home = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert 'href="tutorials/1_own_shape.html"' in home
    for found in tmp_path.rglob("*.html"):  # nothing comes from elsewhere
        outside = r'<(?:script|link)[^>]+(?:src|href)="(https?://[^"]+)"'
        assert not re.findall(outside, found.read_text(encoding="utf-8")), found
    assert shutil.which("chromium") is None or _loads(tmp_path)


def _loads(folder: Path) -> bool:
    command = ["chromium", "--headless=new", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    done = subprocess.run(
        [*command, f"--user-data-dir={folder / 'profile'}", (folder / "index.html").as_uri()],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    return "What it simulates" in done.stdout
