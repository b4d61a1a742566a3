"""XML elements with line numbers and strict reading of their attributes."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from diffsim.core.check import require_choice


@dataclass
class Node:
    """An element.

    Attributes:
        tag, attributes, children: Tag, attributes and children of the element in the file.
        where: File and line, for messages.
    """

    tag: str
    attributes: dict[str, str]
    where: str
    children: list[Node] = field(default_factory=list)

    def error(self, message: str) -> ValueError:
        """A ValueError that names file and line."""
        return ValueError(f"{self.where}: {message}")

    def require_choice(self, name: str, value: str, choices: Iterable[str]) -> str:
        """``require_choice`` that names file and line."""
        try:
            return require_choice(name, value, choices)
        except ValueError as error:
            raise self.error(str(error)) from error

    def require_attributes(self, known: Iterable[str]) -> None:
        """Refuse attributes that would be dropped."""
        for name in self.attributes:
            self.require_choice(f"attribute of <{self.tag}>", name, sorted(known))

    def text(self, name: str) -> str:
        """An attribute that must be there."""
        if name not in self.attributes:
            raise self.error(f'<{self.tag}> needs {name}="..."')
        return self.attributes[name]

    def numbers(self, name: str, count: int) -> list[float]:
        """Numbers of an attribute, separated by spaces."""
        text = self.text(name)
        try:
            values = [float(v) for v in text.split()]
        except ValueError as error:
            raise self.error(f"{name}={text!r} must be {count} numbers: {error}") from error
        if not all(math.isfinite(v) for v in values):
            raise self.error(f"{name}={text!r} must be finite")
        if len(values) != count:
            raise self.error(f"{name}={text!r} must be {count} numbers, got {len(values)}")
        return values


def read_nodes(path: Path) -> Node:
    """Root element of a file.

    Raises:
        ValueError: not well-formed; with the line.
    """
    stack: list[Node] = [Node("", {}, str(path))]
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        node = Node(tag, attributes, f"{path.name}, line {parser.CurrentLineNumber}")
        stack[-1].children.append(node)
        stack.append(node)

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda tag: stack.pop()
    try:
        parser.Parse(path.read_bytes(), True)
    except expat.ExpatError as error:
        raise ValueError(
            f"{path.name}, line {error.lineno}: not XML: {expat.ErrorString(error.code)}"
        ) from error
    return stack[0].children[0]
