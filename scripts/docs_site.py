"""Build the site, and hooks of mkdocs.yml: pages that are written elsewhere, links between them.

    python scripts/docs_site.py [--serve]

Tutorials are notebooks, the changelog and the guide for contributors stand at the root, and the API
has a page for each room: all become pages here, so that nothing is kept twice.
"""

from __future__ import annotations

import argparse
import ast
import functools
import http.server
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
AT_ROOT = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "README.md": "index.md",
}
# :class:`~diffsim.soft.Muscle` of the docstrings, as Markdown renders it
_ROLE = re.compile(r":(?:class|func|meth|mod|attr|data|exc):\s*<code>(~?)([\w.]+)</code>")
TARGET = ROOT / "runs" / "docs"
FRONT = """<!doctype html>
<meta charset="utf-8"><title>diffsim</title>
<meta http-equiv="refresh" content="0; url={version}/index.html">
<a href="{version}/index.html">diffsim {version}</a>
"""
_LINK = re.compile(r"(\]\()([^)#\s:]+)((?:#[^)]*)?\))")
_TO_DOCS = re.compile(r"(\]\(|^\[[^\]]+\]: )docs/", re.M)  # links of files at the root


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the pages of rooms and of records into the navigation."""
    for part in config.nav:
        if "API" in part:
            part["API"] += [{room: f"reference/{room}.md"} for room in rooms()]
        if "Benchmarks" in part:
            pages = sorted(p.name for p in (ROOT / "docs" / "measured").glob("*.md"))
            listed = [f"measured/{name}" for name in pages if name != "README.md"]
            part["Benchmarks"][-1]["Measured"] += listed
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Make pages of notebooks, of files at the root and of rooms."""
    for file in list(files):
        if file.src_uri.endswith(".ipynb"):
            files.remove(file)
            text = notebook(Path(file.abs_src_path))
            uri = file.src_uri.replace(".ipynb", ".md")
            files.append(File.generated(config, uri, content=text))
        elif file.src_uri.endswith(".json"):
            files.remove(file)
    for name, uri in AT_ROOT.items():
        if uri != "index.md":
            text = (ROOT / name).read_text(encoding="utf-8")
            files.append(File.generated(config, uri, content=_TO_DOCS.sub(r"\1", text)))
    for room in rooms():
        text = f"---\ntitle: {room}\n---\n\n::: diffsim.{room}\n"
        files.append(File.generated(config, f"reference/{room}.md", content=text))
    return files


def on_page_markdown(markdown: str, *, page: Any, files: Files, **_: Any) -> str:
    """Let links lead to pages of the site; what has no page becomes plain text."""
    folder = Path(page.file.src_uri).parent

    def turned(match: re.Match[str]) -> str:
        start, target, end = match.groups()
        if target.startswith("<") or target.startswith("/"):
            return match.group()
        where = _flat(folder / target)
        if where.endswith(".ipynb"):
            return f"{start}{target[: -len('.ipynb')]}.md{end}"
        if files.get_file_from_path(where) is not None:
            return match.group()
        outside = _flat(Path("docs") / folder / target)
        if outside in AT_ROOT:
            up = "../" * len(folder.parts)
            return f"{start}{up}{AT_ROOT[outside]}{end}"
        return match.group()

    parts = re.split(r"(```.*?```)", markdown, flags=re.S)  # code stays
    return "".join(
        part if part.startswith("```") else _unlinked(_LINK.sub(turned, part), folder, files)
        for part in parts
    )


def on_page_content(html: str, **_: Any) -> str:
    """Roles of the docstrings as links to what they name, where the site has it."""

    def linked(match: re.Match[str]) -> str:
        short, name = match.groups()
        shown = name.rpartition(".")[2] if short else name
        return f'<autoref identifier="{name}" optional><code>{shown}</code></autoref>'

    return _ROLE.sub(linked, html)


def notebook(path: Path) -> str:
    """A notebook's text and code as Markdown, with what its cells print (tutorial_outputs.py)."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    kept = json.loads(path.with_name("outputs.json").read_text(encoding="utf-8"))
    outputs = iter(kept[path.name])
    parts = []
    for cell in cells:
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(text)
            continue
        parts.append(f"```python\n{text}\n```")
        if printed := next(outputs):
            parts.append(f"```text\n{printed}\n```")
    return "\n\n".join(parts)


def rooms() -> list[str]:
    """Packages that say what they offer, such as ``soft`` and ``stokes.shapes``."""
    found = []
    for path in sorted((ROOT / "diffsim").rglob("__init__.py")):
        name = ".".join(path.parent.relative_to(ROOT / "diffsim").parts)
        tree = ast.parse(path.read_text(encoding="utf-8"))
        offers = any(
            isinstance(node, (ast.Assign, ast.AnnAssign))
            and getattr(node.targets[0] if isinstance(node, ast.Assign) else node.target, "id", "")
            == "__all__"
            for node in tree.body
        )
        if name and offers and not name.startswith("_"):
            found.append(name)
    return found


def _unlinked(text: str, folder: Path, files: Files) -> str:
    """Links to files of the repository that have no page, as their text with the file's name."""

    def plain(match: re.Match[str]) -> str:
        shown, target = match.group(1), match.group(2)
        where = _flat(folder / target)
        if files.get_file_from_path(where) is not None or not _in_repository(folder, target):
            return match.group()
        return f"{shown} (`{_flat(Path('docs') / folder / target)}`)"

    return re.sub(r"(?<!!)\[([^\]]*)\]\(([^)#\s:]+)(?:#[^)]*)?\)", plain, text)


def _in_repository(folder: Path, target: str) -> bool:
    outside = _flat(Path("docs") / folder / target)
    at_root = folder == Path() and (ROOT / target).exists() and not (ROOT / outside).exists()
    return at_root or ((ROOT / outside).exists() and not outside.startswith("docs/"))


def _flat(path: Path) -> str:
    """The path without ``..``, as it is written in the site."""
    parts: list[str] = []
    for part in path.parts:
        if part == ".." and parts:
            parts.pop()
        elif part != ".":
            parts.append(part)
    return "/".join(parts)


def build() -> str:
    """Write the site of this version beside those of others, and which versions there are.

    Returns:
        The version.
    """
    stated = (ROOT / "diffsim" / "core" / "version.py").read_text(encoding="utf-8")
    version = re.findall(r'^__version__ = "([^"]+)"', stated, re.M)[0]
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet"]
    subprocess.run(
        [*command, "--site-dir", str(TARGET / version)],
        check=True,
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )
    found = [path.parent.name for path in TARGET.glob("*/index.html")]
    ordered = sorted(found, key=_parts, reverse=True)
    listed = [
        {"version": v, "title": v, "aliases": ["latest"] if v == ordered[0] else []}
        for v in ordered
    ]
    (TARGET / "versions.json").write_text(json.dumps(listed), encoding="utf-8")
    (TARGET / "index.html").write_text(FRONT.format(version=ordered[0]), encoding="utf-8")
    return version


def serve(port: int) -> None:
    """Show the site to browsers of this machine, until Ctrl-C."""
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(TARGET))
    with http.server.ThreadingHTTPServer(("127.0.0.1", port), handler) as server:
        print(f"http://127.0.0.1:{server.server_port}/ (Ctrl-C ends)", flush=True)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()


def _parts(version: str) -> list[int]:
    """Numbers of a version, to put 0.10 after 0.9."""
    return [int(number) for number in re.findall(r"\d+", version)]


def main() -> None:
    parser = argparse.ArgumentParser(description="Build the site into runs/docs.")
    parser.add_argument("--serve", action="store_true", help="and show it on 127.0.0.1")
    parser.add_argument("--port", type=int, default=8000, help="of --serve (default: %(default)s)")
    given = parser.parse_args()
    print(f"site: {TARGET / build() / 'index.html'}", flush=True)
    if given.serve:
        serve(given.port)


if __name__ == "__main__":
    main()
