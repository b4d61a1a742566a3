"""Surfaces in OBJ, OFF and PLY: what is wrong with them, and in which line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from diffsim.core.errors import MeshError

_AGAIN = "copy or export the file again"
# beyond 1e99 products of three coordinates are no numbers
_NUMBER = rb"[-+]?(?:\d{1,99}\.?\d*|\.\d+)(?:[eE](?:-\d+|\+?0*\d{1,2}))?"
_REFERENCE = rb"-?\d+(?:/-?\d*){0,2}"
_REST = rb"[ \t]*$)[^\n]*"
_ZERO_INDEX = re.compile(rb"^f\b[^\n]*[ \t]0+(?=[/\s]|$)", re.MULTILINE)
_OBJ_WRONG = {
    "a vertex needs three finite numbers": re.compile(
        rb"^[ \t]*v[ \t]+(?!" + _NUMBER + rb"(?:[ \t]+" + _NUMBER + rb"){2,}" + _REST, re.MULTILINE
    ),
    "a face needs three whole numbers of vertices": re.compile(
        rb"^[ \t]*f[ \t]+(?!" + _REFERENCE + rb"(?:[ \t]+" + _REFERENCE + rb"){2,}" + _REST,
        re.MULTILINE,
    ),
}
_IS_NUMBER = re.compile(_NUMBER).fullmatch
_MOST_SHOWN = 60  # letters of a line in a message
_MOST_DIGITS = 18  # of 64 bits
_SIZES = {
    b"char": 1, b"uchar": 1, b"short": 2, b"ushort": 2, b"int": 4, b"uint": 4, b"float": 4,
    b"double": 8, b"int8": 1, b"uint8": 1, b"int16": 2, b"uint16": 2, b"int32": 4, b"uint32": 4,
    b"float32": 4, b"float64": 8,
}  # fmt: skip
_FORMATS = (b"ascii", b"binary_little_endian", b"binary_big_endian")

#: Number of a line in its file, and its words.
Row = tuple[int, list[bytes]]


def check_obj(path: Path, content: bytes) -> None:
    """Refuse lines of vertices and faces that are none.

    Raises:
        MeshError: such a line, with its number.
    """
    content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"\\\n" in content:
        return  # lines that go on are the reader's
    if zero := _ZERO_INDEX.search(content):
        line = content[: zero.start()].count(b"\n") + 1
        raise MeshError(f"{path}, line {line}: a face has vertex 0, but OBJ counts from 1")
    for what, wrong in _OBJ_WRONG.items():
        if found := wrong.search(content):
            line = content[: found.start()].count(b"\n") + 1
            raise MeshError(f"{path}, line {line}: {what}, got {_line_shown(found[0])}")


def check_off(path: Path, content: bytes) -> None:
    """The header of an OFF file against the lines that follow, and these one by one.

    Raises:
        MeshError: cut off, or a line that is wrong, with its number.
    """
    rows = _rows(content.splitlines(), 1)
    first = rows[0][1] if rows else [b""]
    if not first[0].upper().endswith(b"OFF"):
        raise MeshError(f"{path}, line 1: OFF files begin with 'OFF', got {_line_shown(first[0])}")
    if b"BINARY" in first:
        return  # only its reader knows it
    start = 1 if len(first) > 1 else 2
    head = first[1:] if len(first) > 1 else (rows[1][1] if len(rows) > 1 else [])
    counts = [_whole(word) for word in head[:2]]
    if len(counts) < 2 or min(counts) < 0:
        raise MeshError(
            f"{path}: its header must give the counts of vertices and faces as whole numbers, got "
            f"{_line_shown(b' '.join(head))}"
        )
    vertices, faces = counts
    _check_room(path, rows[start:], {"vertices": vertices, "faces": faces})
    _check_vertices(path, rows[start : start + vertices], range(3))
    _check_faces(path, rows[start + vertices : start + vertices + faces], vertices)


@dataclass
class _Element:
    """What a PLY header says of one kind of its content."""

    name: str  # "vertex", "face" or another
    count: int  # of its entries
    # bytes of each property by name; of a list those of its count and of an entry
    sizes: dict[str, tuple[int, ...]] = field(default_factory=dict)

    @property
    def least(self) -> int:
        """Bytes of an entry, at least: a face has three vertices, another list may be empty."""
        entries = 3 if self.name == "face" else 0
        first = next((name for name, size in self.sizes.items() if len(size) == 2), None)
        return sum(
            size[0] + (entries * size[1] if name == first else 0)
            for name, size in self.sizes.items()
        )


def check_ply(path: Path, content: bytes) -> None:
    """The header of a PLY file against what follows; text is looked through line by line.

    Raises:
        MeshError: cut off, or a line that is wrong, with its number.
    """
    end = re.search(rb"^end_header[ \t]*(?:\r\n|\n|\r)", content, re.MULTILINE)
    if content[:3] != b"ply":
        raise MeshError(
            f"{path}, line 1: PLY files begin with 'ply', got {_line_shown(content[:20])}"
        )
    if end is None:
        raise MeshError(f"{path} is cut off: its header has no 'end_header'; {_AGAIN}")
    lines = content[: end.end()].splitlines()
    elements, kind = _ply_header(path, lines)
    vertex = next((e for e in elements if e.name == "vertex"), None)
    if vertex is None or not {"x", "y", "z"} <= vertex.sizes.keys():
        raise MeshError(f"{path}: its header must name vertices with the properties x, y and z")
    if kind != b"ascii":
        needed, there = sum(e.count * e.least for e in elements), len(content) - end.end()
        if there < needed:
            said = " and ".join(f"{e.count} of {e.name}" for e in elements)
            raise MeshError(
                f"{path} is cut off: its header says {said}, at least {needed} bytes, but {there} "
                f"follow; {_AGAIN}"
            )
        return
    rows = _rows(content[end.end() :].splitlines(), len(lines) + 1)
    _check_room(path, rows, {f"of {e.name}": e.count for e in elements})
    for element in elements:
        own, rows = rows[: element.count], rows[element.count :]
        names = list(element.sizes)
        if element is vertex:
            _check_vertices(path, own, [names.index(axis) for axis in "xyz"])
        elif element.name == "face" and names and len(element.sizes[names[0]]) == 2:
            _check_faces(path, own, vertex.count)


def _ply_header(path: Path, lines: Sequence[bytes]) -> tuple[list[_Element], bytes]:
    """Elements that a header names, and how their content is written."""
    elements: list[_Element] = []
    kind = b""
    for number, words in _rows(lines, 1):
        wrong = ""
        if words[0] == b"format":
            kind = words[1] if len(words) > 1 else b""
            wrong = "" if kind in _FORMATS else f"the format must be one of {_list(_FORMATS)}"
        elif words[0] == b"element":
            if len(words) == 3 and _whole(words[2]) >= 0:
                elements.append(_Element(words[1].decode("latin-1"), _whole(words[2])))
            else:
                wrong = "an element needs a name and a count"
        elif words[0] == b"property":
            kinds = words[2:-1] if words[1:2] == [b"list"] else words[1:-1]
            count = 2 if words[1:2] == [b"list"] else 1
            if not elements or len(kinds) != count or any(k not in _SIZES for k in kinds):
                wrong = f"a property needs an element before it, a name, and of {_list(_SIZES)}"
            else:
                name = words[-1].decode("latin-1")
                elements[-1].sizes[name] = tuple(_SIZES[k] for k in kinds)
        if wrong:
            raise MeshError(f"{path}, line {number}: {wrong}, got {_line_shown(b' '.join(words))}")
    if not kind:
        raise MeshError(f"{path}: its header has no line 'format'")
    return elements, kind


def _rows(lines: Sequence[bytes], first: int) -> list[Row]:
    """Lines with words, without comments; the first has the number ``first``."""
    words = [line.split(b"#")[0].split() for line in lines]
    return [(number, row) for number, row in enumerate(words, first) if row]


def _check_room(path: Path, rows: Sequence[Row], counts: dict[str, int]) -> None:
    if len(rows) < sum(counts.values()):
        said = " and ".join(f"{count} {name}" for name, count in counts.items())
        raise MeshError(
            f"{path} is cut off: its header says {said}, but {len(rows)} lines follow; {_AGAIN}"
        )


def _check_vertices(path: Path, rows: Sequence[Row], places: Sequence[int]) -> None:
    last = max(places)
    for number, row in rows:
        if len(row) <= last or not all(_IS_NUMBER(row[place]) for place in places):
            raise MeshError(
                f"{path}, line {number}: a vertex needs three finite numbers, got "
                f"{_line_shown(b' '.join(row))}"
            )


def _check_faces(path: Path, rows: Sequence[Row], num_vertices: int) -> None:
    """Each a count and as many vertices, of 0 to ``num_vertices - 1``."""
    for number, row in rows:
        count = _whole(row[0])
        indices = [_whole(word) for word in row[1 : count + 1]]
        if count < 3 or len(indices) < count or min(indices) < 0:
            raise MeshError(
                f"{path}, line {number}: a face needs a count of at least 3 and as many whole "
                f"numbers of vertices, got {_line_shown(b' '.join(row))}"
            )
        if (worst := max(indices)) >= num_vertices:
            raise MeshError(
                f"{path}, line {number}: a face has vertex {worst}, but there are {num_vertices}, "
                "counted from 0"
            )


def _whole(word: bytes) -> int:
    """A count or an index; -1 where it is none, or longer than any file."""
    return int(word) if word.isdigit() and len(word) <= _MOST_DIGITS else -1


def _line_shown(text: bytes) -> str:
    return repr(text[:_MOST_SHOWN].decode("latin-1").strip())


def _list(words: Sequence[bytes] | dict[bytes, int]) -> str:
    return ", ".join(word.decode() for word in words)
