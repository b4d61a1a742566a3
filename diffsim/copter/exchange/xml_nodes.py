"""XML elements with line numbers and strict reading of their attributes and contents.

Files of strangers are bounded: no document type, hence no entities that stand for more than they
show; an end of size, number and nesting of elements.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from diffsim.core.check import require_choice
from diffsim.core.xml_text import NO_DOCUMENT_TYPE

MAX_BYTES = 20_000_000
MAX_NODES = 1_000_000
MAX_DEPTH = 50


@dataclass
class Node:
    """An element."""

    # tag, attributes, children: as in the file
    tag: str
    attributes: dict[str, str]
    where: str  # file and line, for messages
    children: list[Node] = field(default_factory=list)
    content: str = ""  # text between its tags, without that of its children

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

    def all(self, tag: str) -> list[Node]:
        """Children of a tag."""
        return [child for child in self.children if child.tag == tag]

    def one(self, tag: str) -> Node | None:
        """The child of a tag, None where there is none; two are an error."""
        found = self.all(tag)
        if len(found) > 1:
            raise found[1].error(f"<{tag}> stands twice in <{self.tag}>")
        return found[0] if found else None

    def value(self, tag: str, default: float | None = None) -> float:
        """The number in a child."""
        child = self.one(tag)
        if child is None:
            if default is None:
                raise self.error(f"<{self.tag}> needs <{tag}>")
            return default
        return child.content_numbers(1)[0]

    def content_numbers(self, count: int) -> list[float]:
        """Numbers between the tags, separated by spaces."""
        return self._numbers(f"<{self.tag}>", self.content.strip(), count)

    def numbers(self, name: str, count: int) -> list[float]:
        """Numbers of an attribute, separated by spaces."""
        return self._numbers(name, self.text(name), count)

    def _numbers(self, name: str, text: str, count: int) -> list[float]:
        try:
            values = [float(v) for v in text.split()]
        except ValueError as error:
            raise self.error(f"{name}={text!r} must be {count} numbers: {error}") from None
        if not all(math.isfinite(v) for v in values):
            raise self.error(f"{name}={text!r} must be finite")
        if len(values) != count:
            raise self.error(f"{name}={text!r} must be {count} numbers, got {len(values)}")
        return values


def read_nodes(path: Path) -> Node:
    """Root element of a file.

    Raises:
        ValueError: not well-formed, over the bounds, or with a document type; with the line.
    """
    if (size := path.stat().st_size) > MAX_BYTES:
        raise ValueError(f"{path}: must have at most {MAX_BYTES:,} bytes, got {size:,}")
    return parse_nodes(path.read_bytes(), path.name)


def parse_nodes(content: bytes, source: str) -> Node:
    """``read_nodes`` of a text that messages call ``source``."""
    stack: list[tuple[Node, list[str]]] = [(Node("", {}, source), [])]
    parser = expat.ParserCreate()
    count = 0

    def here() -> str:
        return f"{source}, line {parser.CurrentLineNumber}"

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if count > MAX_NODES or len(stack) > MAX_DEPTH:
            bound = f"{MAX_NODES:,} elements" if count > MAX_NODES else f"{MAX_DEPTH} levels"
            raise ValueError(f"{here()}: more than {bound}")
        node = Node(tag, attributes, here())
        stack[-1][0].children.append(node)
        stack.append((node, []))

    def end(tag: str) -> None:
        node, texts = stack.pop()
        node.content = "".join(texts)

    def refuse(*_: object) -> None:
        raise ValueError(f"{here()}: {NO_DOCUMENT_TYPE}")

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.StartDoctypeDeclHandler = refuse
    parser.CharacterDataHandler = lambda data: stack[-1][1].append(data)
    parser.buffer_text = True
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise ValueError(
            f"{source}, line {error.lineno}: not XML: {expat.ErrorString(error.code)}"
        ) from error
    return stack[0][0].children[0]
