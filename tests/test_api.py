"""What is public: rooms resolve, imports are light, the page is complete, examples obey."""

import ast
import importlib
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import diffsim
from diffsim.cli.main import COMMANDS
from tests.derivatives.public import load_api_page

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
PACKAGES = sorted(p.name for p in pkgutil.walk_packages(diffsim.__path__, "diffsim.") if p.ispkg)
SCRIPTS = sorted((ROOT / "examples").rglob("*.py"))


def offers(package: str) -> list[str]:
    try:
        return list(getattr(importlib.import_module(package), "__all__", ()))
    except ImportError as error:  # an extra that is not installed
        pytest.skip(str(error))


def imported_by(code: str) -> set[str]:
    """Modules that are loaded after running the code in a fresh interpreter."""
    told = subprocess.run(
        [sys.executable, "-c", f"import sys\n{code}\nprint(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
    return set(told.stdout.splitlines()[-1].split())


def rooms_of(modules: set[str]) -> set[str]:
    seen = {m.split(".")[1] for m in modules if m.startswith("diffsim.")}
    return {room for room in seen if not room.startswith("_core")}  # compiled


def test_importing_diffsim_imports_neither_torch_nor_scipy():
    loaded = imported_by("import diffsim\ndiffsim.DiffsimError")
    assert not loaded & {"torch", "scipy", "numpy"}
    assert rooms_of(loaded) == {"core"}


@pytest.mark.parametrize("code", ["parser().format_help()", "main(['info'])"])
def test_help_and_info_import_no_simulator(code):
    loaded = imported_by(f"from diffsim.cli.main import main, parser\n{code}")
    assert not loaded & {"torch", "scipy"}
    assert rooms_of(loaded) == {"cli", "core"}


@pytest.mark.parametrize("room", diffsim.ROOMS)
def test_rooms_come_when_asked_for(room):
    assert room in dir(diffsim) and room in diffsim.__all__
    offers(f"diffsim.{room}")
    assert getattr(diffsim, room) is sys.modules[f"diffsim.{room}"]


def test_no_other_name_is_offered():
    with pytest.raises(AttributeError, match="no attribute 'softt'"):
        _ = diffsim.softt


@pytest.mark.parametrize("package", PACKAGES)
def test_every_name_in_all_resolves(package):
    names = offers(package)
    module = importlib.import_module(package)
    assert module.__doc__, f"{package} has no docstring"
    missing = [name for name in names if not hasattr(module, name)]
    assert not missing and len(names) == len(set(names))
    if package.count(".") == 1:
        assert names, f"the room {package} does not say what it offers"


@pytest.mark.parametrize("package", PACKAGES)
def test_the_page_says_what_is_offered_and_by_default(package):
    """Where this fails: python scripts/api_page.py."""
    if offers(package):
        section = PAGE.partition(f"### {package}\n")[2].partition("\n### ")[0].rstrip()
        assert section == load_api_page().table(package).partition("\n")[2]


def public_modules() -> tuple[str, ...]:
    part = PAGE.partition("## Public modules")[2].partition("\n## ")[0]
    return tuple(re.findall(r"^- `([\w.*]+)`", part, re.MULTILINE))


def is_public(module: str, name: str) -> bool:
    if name != "__version__" and any(n.startswith("_") for n in (*module.split("."), name)):
        return False
    for listed in public_modules():
        if module == listed or (listed.endswith(".*") and f"{module}.".startswith(listed[:-1])):
            return True
    package = importlib.import_module(module)
    full = f"{module}.{name}"
    if full in public_modules() or (full in PACKAGES and offers(full)):
        return True
    return name in getattr(package, "__all__", ())


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda p: str(p.relative_to(ROOT / "examples")))
def test_examples_use_public_names_only(path):
    private = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] == "diffsim":
            private += [
                f"{node.module}.{alias.name}"
                for alias in node.names
                if not is_public(str(node.module), alias.name)
            ]
        if isinstance(node, ast.Attribute) and re.fullmatch(r"_[a-z]\w*", node.attr):
            private += [node.attr] if not is_own(node) else []
    assert not private


def is_own(node: ast.Attribute) -> bool:
    return isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")


def test_every_command_has_help_and_arguments():
    for name, module in COMMANDS.items():
        assert module.HELP and callable(module.add_arguments) and callable(module.command), name
