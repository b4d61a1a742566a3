"""Names and nouns: functions are called by what they do, classes by what they are.

Neither is a bare participle; a constant says of what it is, a docstring more than a unit.
"""

import ast
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

import diffsim

FOLDER = Path(diffsim.__file__).parent
# past participles of verbs that do not end in -ed
IRREGULAR = """
    begun bent blown bound bought brought built caught chosen drawn driven fallen felt flown found
    given gone grown heard held hung kept known laid led left lent lost made meant met moved
    paid proven risen run said seen sent shown shrunk sorted spent split spread stood struck sunk
    swept taken taught thrown told torn understood won worn written
"""
PARTICIPLES = frozenset(IRREGULAR.split())
# documented classes, two of which are nouns too
PUBLIC = frozenset(("Chosen", "Ground", "Identified", "Run", "Trained"))
NO_PARTICIPLES = frozenset(("embed", "exceed", "feed", "need", "proceed", "seed", "speed"))
VERBS_TOO = frozenset(("split", "spread"))
# each had up to six meanings: MAX_PIECES and WRONG_SHEET_SD say of what
VAGUE = frozenset(("FAR", "MOST", "WIDE", "FEW", "NEAR", "SETTLED", "FEWEST"))
STILL = frozenset(("FEW", "MOST", "FEWEST"))  # record/signals, judge/gain, bench/run_zeros
# a line such as "mass: (num_parts,) [kg].", or "mass: Tensor  # (num_parts,) [kg]" of a field
ONLY_UNIT = re.compile(
    r"^ {4,}\w+: (?:.*  # )?(?:\([^)]*\),? ?)?(?:float64|int64|bool)? ?\[[^\]]+\]\.?$"
)


def is_participle(word: str) -> bool:
    """Whether a word in small letters is the past participle of a verb."""
    if word in NO_PARTICIPLES | VERBS_TOO:
        return False
    return word.endswith("ed") or word in PARTICIPLES


def is_bare_function(node: ast.AST) -> bool:
    """Whether a private function is called by one past participle and nothing else."""
    return (
        isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
        and bool(re.fullmatch(r"_[a-z]+", node.name))
        and is_participle(node.name[1:])
    )


def is_bare_class(node: ast.AST) -> bool:
    """Whether a class, private or not, is called by one past participle and nothing else."""
    return (
        isinstance(node, ast.ClassDef)
        and bool(re.fullmatch(r"_?[A-Z][a-z]+", node.name))
        and is_participle(node.name.lstrip("_").lower())
    )


@cache
def documented() -> dict[Path, list[ast.Module | ast.ClassDef | ast.FunctionDef]]:
    """Files of the package, what may have a docstring in each: first the module itself."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    trees = {p.relative_to(FOLDER): ast.parse(p.read_text("utf-8")) for p in FOLDER.rglob("*.py")}
    return {p: [n for n in ast.walk(trees[p]) if isinstance(n, kinds)] for p in sorted(trees)}


def names_of(is_bare: Callable[[ast.AST], bool]) -> list[str]:
    """Names that are bare participles, with their files."""
    nodes = ((place, node) for place, own in documented().items() for node in own)
    return [f"{place}:{n.lineno} {n.name}" for place, n in nodes if is_bare(n)]


@pytest.mark.parametrize(
    ("is_bare", "text", "expected"),
    [
        (is_bare_function, "def _shown(): pass", True),
        (is_bare_function, "async def _shown(): pass", True),
        (is_bare_function, "def _add_units(): pass", False),
        (is_bare_function, "def shown(): pass", False),
        (is_bare_function, "def _seed(): pass", False),
        (is_bare_class, "class _Told: pass", True),
        (is_bare_class, "class Told: pass", True),
        (is_bare_class, "class Speed: pass", False),
        (is_bare_class, "class ToldWords: pass", False),
    ],
)
def test_what_a_bare_participle_is(is_bare, text, expected):
    assert is_bare(ast.parse(text).body[0]) is expected


def test_no_private_function_is_one_bare_participle():
    assert names_of(is_bare_function) == []


def test_no_class_is_one_bare_participle():
    found = names_of(is_bare_class)
    assert [name for name in found if name.split()[-1] not in PUBLIC] == []


def docstrings():
    """Every docstring of the package, with its place."""
    for place, nodes in documented().items():
        for node in nodes:
            if text := ast.get_docstring(node, clean=False):
                yield f"{place} {getattr(node, 'name', '')}", text


def has_only_units(text: str) -> list[str]:
    return [line.strip() for line in text.splitlines() if ONLY_UNIT.match(line)]


def test_a_noun_stands_beside_every_unit():
    sources = ((path, path.read_text("utf-8")) for path in sorted(FOLDER.rglob("*.py")))
    texts = (*docstrings(), *sources)
    found = {place: lines for place, text in texts if (lines := has_only_units(text))}
    assert found == {}
    assert has_only_units("    mass: Tensor  # (num_parts,) [kg]") != []
    assert has_only_units("    mass: Tensor  # mass of each part, (num_parts,) [kg]") == []
    assert has_only_units("    mass: (num_parts,) [kg].") == ["mass: (num_parts,) [kg]."]
    assert has_only_units("    mass: Mass of each part, (num_parts,) [kg].") == []


def test_constants_say_of_what_they_are():
    """Constants of modules; three are left, and none may be new."""
    named = []
    for module, *_ in documented().values():
        for node in module.body:
            targets = node.targets if isinstance(node, ast.Assign) else []
            named += [t.id for t in targets if isinstance(t, ast.Name) and t.id in VAGUE]
    assert len(set(named)) == len(named)
    assert set(named) <= STILL
