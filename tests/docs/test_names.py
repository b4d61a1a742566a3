"""What pages name is there: modules, files, commands; extras hold what the README says."""

import importlib
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "examples/*.md")
    for path in ROOT.glob(pattern)
    if path.name not in ("CHANGELOG.md", "numerics.md", "api.md")  # of what is gone; of all rooms
)
DOTTED = re.compile(r"(?<![\w/.-])diffsim(?:\.[a-z_]\w*)*(?:\.[A-Z]\w*(?:\.\w+)?)?(?![\w/-])")
FOLDERS = "benchmarks|csrc|diffsim|docs|examples|labs|rl|scripts|studies|tests"
FILE = re.compile(rf"(?<![\w/.-])((?:{FOLDERS})/[\w./-]*\w\.(?:py|h|cpp|ya?ml|md|csv))(?!\w)")
COMMAND = re.compile(r"python -m ((?:benchmarks|examples|labs|rl|studies|tests)(?:\.\w+)+)")
PORT = re.compile(r"`(with_\w+)`")
TEMPLATE = re.compile(r"NAME|KIND|TABLE|COMMIT")


def wrong_in(text: str) -> list[str]:
    """Names of a page that are not there."""
    code = "\n".join(re.findall(r"```.*?```|`[^`\n]+`", text, re.S))
    wrong = [name for name in set(DOTTED.findall(code)) if not exists(name)]
    wrong += [f for f in set(FILE.findall(text)) if not TEMPLATE.search(f) and not has_file(f)]
    wrong += [m for m in set(COMMAND.findall(text)) if not has_module(m)]
    return sorted(wrong + [p for p in set(PORT.findall(text)) if p not in defined()])


@cache
def exists(name: str) -> bool:
    """Whether a dotted name is a module, or something that one has."""
    if name.endswith((".py", ".so", ".yaml", ".environments", ".devices", ".systems")):
        return True  # files, and groups of entry points, which test_adding holds
    parts = name.split(".")
    for k in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:k]))
        except ModuleNotFoundError:
            continue
        for part in parts[k:]:
            if not hasattr(found, part):
                return False
            found = getattr(found, part)
        return True
    return False


def has_file(name: str) -> bool:
    return "*" in name or (ROOT / name).exists()


@cache
def has_module(name: str) -> bool:
    """Whether ``python -m`` finds it: by its place, so that nothing is imported."""
    path = ROOT.joinpath(*name.split("."))
    return path.with_suffix(".py").is_file() or (path / "__main__.py").is_file()


@cache
def defined() -> frozenset[str]:
    """Ports of scenes: what the package defines by such a name."""
    texts = (path.read_text(encoding="utf-8") for path in (ROOT / "diffsim").rglob("*.py"))
    return frozenset(name for text in texts for name in re.findall(r"def (with_\w+)", text))


def test_what_pages_name_is_there():
    found = {str(p.relative_to(ROOT)): wrong_in(p.read_text(encoding="utf-8")) for p in PAGES}
    assert {page: wrong for page, wrong in found.items() if wrong} == {}


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("`diffsim.soft.NoSuchBody`", "diffsim.soft.NoSuchBody"),
        ("`diffsim.no_such_room`", "diffsim.no_such_room"),
        ("the file `diffsim/soft/no_such_file.py`", "diffsim/soft/no_such_file.py"),
        ("```sh\npython -m benchmarks.no_such --out A\n```", "benchmarks.no_such"),
        ("changes the scene by `with_term`", "with_term"),
    ],
)
def test_a_name_that_is_not_there_is_seen(text, wrong):
    assert wrong_in(text) == [wrong]


def test_the_walk_of_a_diagnosis_names_its_files():
    """``diffsim.diagnose`` lists the files of each folder in reading order."""
    import diffsim.diagnose

    step = re.compile(r"^\d\. ``(\w+)``: (.*?)(?=^\d\. |\Z|\n\n)", re.S | re.M)
    steps = step.findall(diffsim.diagnose.__doc__)
    folders = dict(steps)
    assert set(folders) == {"checks", "search", "discover", "judge", "say"}
    for folder, words in folders.items():
        missing = [
            name
            for name in re.findall(r"``(\w+)``", words)
            if not (ROOT / "diffsim" / "diagnose" / folder / f"{name}.py").is_file()
        ]
        assert missing == [], folder


def extras() -> dict[str, set[str]]:
    tomllib = pytest.importorskip("tomllib", reason="Python 3.11 or newer")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return {name: set(asked) for name, asked in project["optional-dependencies"].items()}


def test_extras_are_those_that_the_readme_names_and_all_has_what_set_up_installs():
    known = extras()
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    named = re.findall(r"extras: ([\w, ]+)", readme)[0].split(", ")
    assert set(named) <= set(known)
    assert len(known["all"]) == 1
    whole = set(re.findall(r"\[(.+)\]", next(iter(known["all"])))[0].split(","))
    set_up = re.findall(
        r"DIFFSIM_EXTRAS:-([\w,]+)", (ROOT / "scripts" / "setup").read_text(encoding="utf-8")
    )[0]
    assert set(set_up.split(",")) <= whole
    assert set(named) - {"all"} <= whole <= set(known)
