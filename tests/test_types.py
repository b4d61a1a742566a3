"""What a type checker of a user's program sees: the types of diffsim, not Any."""

import ast
import os
import re
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
OFFERING = [
    p
    for p in sorted(ROOT.glob("diffsim/**/__init__.py"))
    if "__all__" in p.read_text(encoding="utf-8")
]

# A line of a user's program, and what mypy says of it.
PROGRAM = (
    ("bar = diffsim.mesh.hex_box((8, 2, 2), (0.1, 0.03, 0.03))", None),
    ("body = soft.SoftBody(bar, dt=0.01, youngs_modulus=1e6, poissons_ratio=0.4)", None),
    ("reveal_type(bar)", 'note: Revealed type is "diffsim.mesh.core.HexMesh"'),
    ("reveal_type(body)", 'note: Revealed type is "diffsim.soft.body.SoftBody"'),
    ("reveal_type(body.dt)", 'note: Revealed type is "float"'),
    ("reveal_type(RodMaterial.density)",
     'note: Revealed type is "diffsim.systems.description.Quantity"'),
    ("soft.SoftBody(bar, dt='1 ms', youngs_modulus=1e6, poissons_ratio=0.4)",
     'error: Argument "dt" to "SoftBody" has incompatible type "str"; expected "float"'),
    ("soft.SoftBody(bar, dt=0.01, youngs_modulus=1e6)",
     'error: Missing named argument "poissons_ratio" for "SoftBody"'),
    ("diffsim.sofft", 'error: Module has no attribute "sofft"'),
)  # fmt: skip


def bound_by(statements: list[ast.stmt]) -> Iterator[str]:
    """Names that a module binds by statements; a type checker knows no others."""
    for node in statements:
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            yield from (alias.asname or alias.name for alias in node.names)
        elif isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            yield node.name
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name))
        elif isinstance(node, (ast.If, ast.With)):
            yield from bound_by(node.body)


@pytest.mark.parametrize("path", OFFERING, ids=lambda p: p.parent.name)
def test_what_is_imported_lazily_is_visible_to_type_checkers(path):
    statements = ast.parse(path.read_text(encoding="utf-8")).body
    (names,) = (
        ast.literal_eval(node.value)
        for node in statements
        if isinstance(node, ast.Assign) and "__all__" in bound_by([node])
    )
    assert set(names) <= set(bound_by(statements))


def test_types_are_packaged():
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert re.search(r'^"diffsim" = \[.*"py\.typed".*\]$', project, re.MULTILINE)
    assert (ROOT / "diffsim" / "py.typed").is_file()


@pytest.fixture(scope="module")
def said(tmp_path_factory) -> dict[str, list[str]]:
    """What mypy says of each line of the program, outside the checkout, diffsim installed."""
    folder = tmp_path_factory.mktemp("user")
    venv.create(folder / "env", symlinks=True)
    python = folder / "env" / "bin" / "python"
    (packages,) = (folder / "env" / "lib").glob("python*/site-packages")
    (packages / "diffsim").symlink_to(ROOT / "diffsim")
    (packages / "others.pth").write_text(sysconfig.get_path("purelib"))
    head = ["import diffsim", "from diffsim import soft",
            "from diffsim.systems.rod.keys import RodMaterial"]  # fmt: skip
    lines = [*head, *(line for line, _ in PROGRAM)]
    (folder / "robot.py").write_text("\n".join(lines) + "\n")
    told = subprocess.run(
        [sys.executable, "-m", "mypy", "--python-executable", str(python), "robot.py"],
        capture_output=True,
        text=True,
        cwd=folder,
        env={k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "MYPYPATH")},
    )
    found: dict[str, list[str]] = {}
    for number, words in re.findall(r"^robot\.py:(\d+): (.*)$", told.stdout, re.MULTILINE):
        found.setdefault(lines[int(number) - 1], []).append(words)
    assert found, told.stdout + told.stderr
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("line", "words"), PROGRAM, ids=[line for line, _ in PROGRAM])
def test_a_users_program_is_checked(said, line, words):
    if words is None:
        assert line not in said
    else:
        assert said[line][0].startswith(words)
