"""Thresholds that decide verdicts, listed in ``thresholds.yaml``, and set to other values."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

import diffsim

LIST = Path(__file__).with_name("thresholds.yaml")
FACTORS = (0.5, 2.0)


@dataclass(frozen=True)
class Threshold:
    """A constant of a module that decides verdicts."""

    module: str  # its module, below ``diffsim``
    name: str  # of the constant
    decides: str  # what it decides
    chosen: str = ""  # cases that chose it, as far as comments and history say
    # whether what lies between it and one is halved and doubled, as of a probability
    of_rest: bool = False

    @property
    def key(self) -> str:
        """Module and name in a word."""
        return f"{self.module}.{self.name}"

    @property
    def value(self) -> Any:
        """Its value now."""
        return getattr(importlib.import_module(f"diffsim.{self.module}"), self.name)

    def times(self, factor: float) -> Any:
        """Its value, or what is left to one, times a factor; counts stay whole and above zero."""
        value = self.value
        if self.of_rest:
            return 1.0 - factor * (1.0 - value)
        if isinstance(value, tuple):
            return tuple(factor * one for one in value)
        return max(1, round(factor * value)) if isinstance(value, int) else factor * value


def listed() -> list[Threshold]:
    """All thresholds of the list."""
    return [Threshold(**row) for row in yaml.safe_load(LIST.read_text(encoding="utf-8"))]


def variant(threshold: Threshold, factor: float) -> str:
    """Name of a threshold at a factor."""
    return f"{threshold.key}_x{factor:g}"


@contextmanager
def put(threshold: Threshold, value: Any) -> Iterator[None]:
    """The threshold at a value, in its module and in all that import it by name."""
    before = threshold.value
    places = [(threshold.module, threshold.name), *_importers(threshold.module, threshold.name)]
    modules = [(importlib.import_module(f"diffsim.{module}"), name) for module, name in places]
    try:
        for module, name in modules:
            setattr(module, name, value)
        yield
    finally:
        for module, name in modules:
            setattr(module, name, before)


@cache
def _trees() -> dict[str, ast.Module]:
    """Syntax of every module that may hold or import a threshold, by its name."""
    root = Path(diffsim.__file__).parent
    return {
        ".".join(path.relative_to(root).with_suffix("").parts): ast.parse(path.read_text("utf-8"))
        for room in ("data", "diagnose", "identify", "systems", "viz", "cli")
        for path in sorted((root / room).rglob("*.py"))
    }


@cache
def _imports() -> dict[tuple[str, str], list[tuple[str, str]]]:
    """Modules that import a name, and what they call it, by its module and the name."""
    out: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for other, tree in _trees().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                for alias in node.names:
                    place = (other.removesuffix(".__init__"), alias.asname or alias.name)
                    out.setdefault((f"{node.module}", alias.name), []).append(place)
    return out


def _importers(module: str, name: str) -> list[tuple[str, str]]:
    """Modules that import a constant by name, and what they call it."""
    return _imports().get((f"diffsim.{module}", name), [])


def bound_early(threshold: Threshold) -> list[str]:
    """Where its value is taken while modules are imported, so that changing it later does nothing.

    Args:
        threshold: One of the list.
    """
    places = {
        threshold.module: threshold.name,
        **dict(_importers(threshold.module, threshold.name)),
    }
    return [
        f"{module}:{node.lineno}"
        for module, name in places.items()
        for node in _early(_trees()[module])
        if isinstance(node, ast.Name) and node.id == name and isinstance(node.ctx, ast.Load)
    ]


def _early(tree: ast.AST) -> Iterator[ast.expr]:
    """Expressions that are computed as a module is imported: all but bodies of functions."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            inner: list[ast.AST] = [*node.args.defaults, *node.decorator_list]
            inner += [d for d in node.args.kw_defaults if d is not None]
        elif isinstance(node, ast.Lambda):
            inner = []
        else:
            inner = [node]
            if isinstance(node, ast.expr):
                yield node
        for one in inner:
            if one is not node and isinstance(one, ast.expr):
                yield one
            yield from _early(one)
