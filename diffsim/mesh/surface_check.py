"""Surface files that are cut off or name vertices that there are not: said before they are read."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from diffsim.core.arrays import Array, IntArray
from diffsim.core.errors import MeshError

_STL_HEADER, _STL_TRIANGLE = 84, 50  # bytes of a binary STL
_ZERO_INDEX = re.compile(rb"^f\b[^\n]*[ \t]0+(?=[/\s]|$)", re.MULTILINE)
_AGAIN = "copy or export the file again"


def check_file(path: Path) -> None:
    """Refuse what the readers would read in part, or with an error of their own.

    Args:
        path: An existing file of a surface.

    Raises:
        MeshError: empty, cut off, or with a face index that the format does not know.
    """
    content = path.read_bytes()
    if not content:
        raise MeshError(f"{path} is empty; {_AGAIN}")
    suffix = path.suffix.lower()
    if suffix == ".stl":
        _check_stl(path, content)
    elif suffix == ".off":
        _check_off(path, content)
    elif suffix == ".obj" and (zero := _ZERO_INDEX.search(content)):
        line = content[: zero.start()].count(b"\n") + 1
        raise MeshError(f"{path}, line {line}: a face has vertex 0, but OBJ counts from 1")


def check_indices(faces: IntArray, x: Array) -> None:
    """Refuse faces with vertices that there are not.

    Raises:
        MeshError: an index is negative or too large; ``indices`` holds the faces.
    """
    bad = np.flatnonzero(((faces < 0) | (faces >= len(x))).any(axis=1))
    if len(bad):
        worst = faces[bad[0]].tolist()
        raise MeshError(
            f"faces must hold indices of the {len(x)} vertices in [0, {len(x)}), but "
            f"{len(bad)} of {len(faces)} do not: face {bad[0]} is {worst}",
            tuple(int(i) for i in bad[:1000]),
        )


def _check_stl(path: Path, content: bytes) -> None:
    if content[:5].lower() == b"solid" and b"facet" in content[:2000]:
        if b"endsolid" not in content[-400:].lower():
            raise MeshError(f"{path} is cut off: it has no 'endsolid' at its end; {_AGAIN}")
        return
    if len(content) < _STL_HEADER:
        raise MeshError(
            f"{path} is cut off: a binary STL has at least {_STL_HEADER} bytes, got "
            f"{len(content)}; {_AGAIN}"
        )
    count = int.from_bytes(content[_STL_HEADER - 4 : _STL_HEADER], "little")
    size = _STL_HEADER + _STL_TRIANGLE * count
    if len(content) < size:
        there = (len(content) - _STL_HEADER) // _STL_TRIANGLE
        raise MeshError(
            f"{path} is cut off: its header says {count} triangles, {size} bytes, but there are "
            f"{there}, {len(content)} bytes; {_AGAIN}"
        )


def _check_off(path: Path, content: bytes) -> None:
    """The counts of the header against the lines that follow."""
    lines = [line.split(b"#")[0].split() for line in content.splitlines()]
    words = [line for line in lines if line]
    head = words[0][1:] if len(words[0]) > 1 else (words[1] if len(words) > 1 else [])
    if len(head) < 2 or not (head[0].isdigit() and head[1].isdigit()):
        return  # a variant that only its reader knows
    wanted = int(head[0]) + int(head[1])
    there = len(words) - (1 if len(words[0]) > 1 else 2)
    if there < wanted:
        raise MeshError(
            f"{path} is cut off: its header says {int(head[0])} vertices and {int(head[1])} faces, "
            f"but {there} lines follow; {_AGAIN}"
        )
