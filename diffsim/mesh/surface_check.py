"""Surface files that are cut off or name vertices that there are not: said before they are read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffsim.core.arrays import Array, IntArray
from diffsim.core.errors import MeshError
from diffsim.mesh.surface_text import check_obj, check_off, check_ply

_STL_HEADER, _STL_TRIANGLE = 84, 50  # bytes of a binary STL
_TEXTS = {".obj": check_obj, ".off": check_off, ".ply": check_ply}
_AGAIN = "copy or export the file again"


def check_file(path: Path) -> None:
    """Refuse what the readers would read in part, or with an error of their own.

    Args:
        path: An existing file of a surface.

    Raises:
        MeshError: empty, cut off, or wrong in a line, which is named.
    """
    content = path.read_bytes()
    if not content:
        raise MeshError(f"{path} is empty; {_AGAIN}")
    suffix = path.suffix.lower()
    if suffix == ".stl":
        _check_stl(path, content)
    elif suffix in _TEXTS:
        if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
            raise MeshError(f"{path} is text in UTF-16; save it in UTF-8")
        _TEXTS[suffix](path, content)


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


def check_finite(x: Array) -> None:
    """Refuse vertices that are no numbers, which a reader drops with their faces.

    Raises:
        MeshError: such a vertex; ``indices`` holds them.
    """
    bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if len(bad):
        raise MeshError(
            f"{len(bad)} of {len(x)} vertices are not finite: vertex {bad[0]} is "
            f"{x[bad[0]].tolist()}",
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
