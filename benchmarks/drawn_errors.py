"""Errors drawn at random over the package and its kernels, for ``planted_errors --draw``.

Own operators, of the kinds that are mistakes of one place: a sign, a dropped term, a factor, an
index, a comparison, a default. Python is read as a tree, so that texts and comments stay as they
are; C++ line by line. What is drawn depends on the seed and on the tree alone. Headers that many
sources include are not drawn: one error in them compiles up to 70 sources, 150 CPU s and more.

Some drawn errors change no answer: a guess, a tolerance, a message. They are told by hand, with the
reason, in ``harmless_errors.yaml``, and leave the count.
"""

from __future__ import annotations

import ast
import random
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from benchmarks.nearest_tests import nearest_tests, sources_above

ROOT = Path(__file__).resolve().parents[1]
HARMLESS = Path(__file__).with_name("harmless_errors.yaml")
DEFAULTS = "tests/test_api.py"  # holds those of all public calls against docs/api.md
KERNELS = "csrc/kernels"
KNOWN = "tests/test_known_numbers.py::test_"
NUMBERS = (
    f"{KNOWN}numbers_are_those_that_are_known",
    f"{KNOWN}what_commands_say_and_write_is_known",
)
OF_COMMANDS = ("cli", "data", "diagnose", "identify", "viz")  # rooms that commands show at once
CONTRACT = "tests/systems/test_kinds.py::test_every_kind_keeps_its_contract"  # what kinds keep
OF_KINDS = ("diffsim/causes/", "diffsim/identify/", "diffsim/systems/")
FOLDERS = {"diffsim": "*.py", KERNELS: "*.[ch]*"}
MOST_SOURCES = 12  # of a header that is drawn: those that include it
KERNEL_EVERY = 3  # one of so many is of a kernel; by lines it would be one of six, often none
SIGNS = {ast.Add: "-", ast.Sub: "+"}
FACTORS = {ast.Mult: "/", ast.Div: "*"}
COMPARISONS = {
    **{ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">"},
    **{ast.Eq: "!=", ast.NotEq: "=="},
}
TOKENS = {  # of C++: what stands there, what stands there with the mistake, of which kind
    **{" + ": (" - ", "sign"), " - ": (" + ", "sign"), " += ": (" -= ", "sign")},
    **{" * ": (" / ", "factor"), " / ": (" * ", "factor")},
    **{" < ": (" <= ", "comparison"), " > ": (" >= ", "comparison"), " <= ": (" < ", "comparison")},
    **{"[0]": ("[1]", "index"), "[1]": ("[0]", "index"), "(0)": ("(1)", "index")},
}


class Site(NamedTuple):
    """A place and its mistake: characters ``start`` to ``end`` of a file become ``new``."""

    start: int
    end: int
    new: str
    kind: str


class Drawn(NamedTuple):
    """A drawn mistake as the plan of planted errors states one."""

    name: str
    file: str
    old: str
    new: str
    means: str
    tests: tuple[str, ...]


def draw(seed: int, num: int, nearest: int | None = None) -> list[Drawn]:
    """Errors of the working tree, each of a file of its own.

    Args:
        seed: Of what is drawn.
        num: Number of errors.
        nearest: Number of test files that are run for each, the nearest ones; None: of all modules
            above it.
    """
    chance = random.Random(seed)
    files = {folder: sorted((ROOT / folder).rglob(like)) for folder, like in FOLDERS.items()}
    files[KERNELS] = [p for p in files[KERNELS] if len(sources_above(p.stem)) <= MOST_SOURCES]
    sizes = {
        folder: [len(path.read_text(encoding="utf-8").splitlines()) for path in paths]
        for folder, paths in files.items()
    }
    drawn: dict[str, Drawn] = {}
    while len(drawn) < num:
        folder = KERNELS if len(drawn) % KERNEL_EVERY == KERNEL_EVERY - 1 else "diffsim"
        (path,) = chance.choices(files[folder], sizes[folder])
        text, name = path.read_text(encoding="utf-8"), str(path.relative_to(ROOT))
        sites = sorted(set(sites_of(path, text)))
        if not sites or name in drawn:
            continue
        site = chance.choice(sites)
        if path.suffix == ".py" and not _is_python(
            text[: site.start] + site.new + text[site.end :]
        ):
            continue  # what is dropped ends between brackets
        if tests := nearest_tests(name, _line_of(text, site))[:nearest]:
            known = NUMBERS[:: -1 if Path(name).parts[1] in OF_COMMANDS else 1]
            tests = [*known, *(test for test in tests if test not in KNOWN)]
            before = [DEFAULTS] if site.kind == "default" and path.suffix == ".py" else []
            after = [CONTRACT] if name.startswith(OF_KINDS) else []
            drawn[name] = _stated(name, text, site, [*before, *tests, *after])
    return list(drawn.values())


def _line_of(text: str, site: Site) -> int:
    return text.count("\n", 0, site.start) + 1


def _is_python(text: str) -> bool:
    try:
        ast.parse(text)
    except SyntaxError:
        return False
    return True


def _stated(name: str, text: str, site: Site, tests: list[str]) -> Drawn:
    """The mistake with as many lines around it as make its text the only one in the file."""
    lines = text.splitlines(keepends=True)
    first = text.count("\n", 0, site.start)
    last = text.count("\n", 0, site.end)
    start = sum(map(len, lines[:first]))
    while True:
        old = "".join(lines[first : last + 1])
        if text.count(old) == 1 or first == 0:
            break
        first -= 1
        start -= len(lines[first])
    new = old[: site.start - start] + site.new + old[site.end - start :]
    number = _line_of(text, site)
    stem = re.sub(r"\W+", "-", name.removeprefix("diffsim/").rpartition(".")[0])
    was = " ".join(text[site.start : site.end].split())
    return Drawn(
        name=f"{stem}-{number}-{site.kind}",
        file=name,
        old=old,
        new=new,
        means=f"{site.kind} in line {number}: {was!r:.60} becomes {site.new!r:.60}",
        tests=tuple(tests),
    )


def sites_of(path: Path, text: str) -> Iterator[Site]:
    """All places of a file where an operator can make a mistake."""
    if path.suffix != ".py":
        yield from _sites_of_kernel(text)
        return
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def span(node: Any) -> tuple[int, int]:
        # columns count bytes; the package is ASCII but for a few texts
        first, last = starts[node.lineno - 1], starts[node.end_lineno - 1]
        return first + node.col_offset, last + node.end_col_offset

    for top in ast.walk(ast.parse(text)):
        if isinstance(top, (ast.FunctionDef, ast.AsyncFunctionDef)):
            for node in ast.walk(top):
                for start, end, new, kind in _mistakes(node, text, span):
                    yield Site(start, end, new, kind)


def _mistakes(node, text, span):  # type: ignore[no-untyped-def]
    if isinstance(node, ast.BinOp) and not _is_text(node):
        (_, left), (right, end) = span(node.left), span(node.right)
        between = text[left:right]
        for table, kind in ((SIGNS, "sign"), (FACTORS, "factor")):
            for operator, new in table.items():
                if isinstance(node.op, operator):
                    old = "+-*/"[(ast.Add, ast.Sub, ast.Mult, ast.Div).index(operator)]
                    if between.count(old) == 1:
                        yield left, right, between.replace(old, new), kind
        if type(node.op) in SIGNS:
            yield left, end, "", "dropped-term"
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        start, _ = span(node)
        yield start, span(node.operand)[0], "", "sign"
    elif isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in COMPARISONS:
        left, right = span(node.left)[1], span(node.comparators[0])[0]
        new = re.sub(r"[<>=!]+", COMPARISONS[type(node.ops[0])], text[left:right], count=1)
        yield left, right, new, "comparison"
    elif isinstance(node, ast.Subscript):
        for part in ast.walk(node.slice):
            if isinstance(part, ast.Constant) and type(part.value) is int:
                yield (
                    *span(part),
                    str(part.value + 1 if part.value < 1 else part.value - 1),
                    "index",
                )
    elif isinstance(node, ast.arguments):
        for default in [*node.defaults, *filter(None, node.kw_defaults)]:
            if isinstance(default, ast.Constant) and isinstance(default.value, (bool, int, float)):
                value = default.value
                other = not value if isinstance(value, bool) else 2 * value + type(value)(1)
                yield *span(default), repr(other), "default"


def _is_text(node: ast.BinOp) -> bool:
    """Whether parts are texts or lists, which are joined and not added."""
    kinds = (ast.JoinedStr, ast.List, ast.Tuple, ast.ListComp, ast.Dict)
    return any(
        isinstance(p, kinds) or (isinstance(p, ast.Constant) and isinstance(p.value, str))
        for p in (node.left, node.right)
    )


def _sites_of_kernel(text: str) -> Iterator[Site]:
    at = 0
    for line in text.splitlines(keepends=True):
        code = line.partition("//")[0]
        if not code.lstrip().startswith(("#", "*", "/*")) and '"' not in code:
            for old, (new, kind) in TOKENS.items():
                for found in re.finditer(re.escape(old), code):
                    yield Site(at + found.start(), at + found.end(), new, kind)
        at += len(line)


def read_harmless() -> dict[str, str]:
    """Reasons by name of drawn errors that change no answer."""
    return dict(yaml.safe_load(HARMLESS.read_text(encoding="utf-8")) or {})
