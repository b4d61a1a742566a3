"""Elements of MATLAB's files of version 5, held against what they say of themselves.

SciPy's reader trusts them: a damaged kind, flag or size ends the process. An element is a kind, a
size and so many bytes; a matrix holds others (MathWorks, MAT-File Format, ch. 1).
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

_MAT_HEADER = 128  # bytes of version 5 before its first element
_MATRIX, _COMPRESSED = 14, 15
_MAT_NUMBERS, _MAT_TEXTS = (1, 2, 3, 4, 5, 6, 7, 9, 12, 13), (16, 17, 18)
_MAT_BYTES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8}  # of a number
_CELL, _STRUCT, _OBJECT, _MAT_OPAQUE = 1, 2, 3, (16, 17)
_MAT_ARRAYS = {4: 1, 5: 3, **dict.fromkeys(range(6, 16), 1)}  # text, sparse and numbers, by class
_MAT_DEPTH = 50


def check_elements(path: Path) -> None:
    """Refuse a file of version 5 whose elements are not what they say.

    Args:
        path: A MAT file; of another version nothing is checked.

    Raises:
        ValueError: what is wrong first.
    """
    content = memoryview(path.read_bytes())
    order = {b"IM": "<", b"MI": ">"}.get(bytes(content[126:_MAT_HEADER]))
    if order is not None and 0 not in content[:4]:  # else version 4, read without such
        _walk_elements(content[_MAT_HEADER:], order, 0)


def _walk_elements(content: memoryview, order: str, depth: int) -> None:
    if depth > _MAT_DEPTH:
        raise ValueError(f"more than {_MAT_DEPTH} matrices inside of each other")
    for kind, inner in _elements(content, order):
        if kind == _COMPRESSED:
            _walk_elements(memoryview(zlib.decompress(inner)), order, depth + 1)
        elif kind == _MATRIX and len(inner):
            _walk_elements(inner, order, depth + 1)
            _check_matrix(list(_elements(inner, order)), order)


def _elements(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Kind and content of each element."""
    while len(content):
        if len(content) < 8:
            raise ValueError("it is cut off")
        kind, size = struct.unpack(f"{order}II", content[:8])
        start = 8
        if kind >> 16:  # up to four bytes stand in the place of the size
            kind, size, start = kind & 0xFFFF, kind >> 16, 4
        end = max(start + size, 8)
        if kind not in (*_MAT_NUMBERS, *_MAT_TEXTS, _MATRIX, _COMPRESSED):
            raise ValueError(f"an element of the unknown kind {kind}")
        if end > len(content) or (start == 4 and size > 4):
            raise ValueError("it is cut off")
        yield kind, content[start : start + size]
        content = content[end + (0 if kind == _COMPRESSED else -end % 8) :]  # filled up to eight


def _check_matrix(parts: list[tuple[int, memoryview]], order: str) -> None:
    """Flags, sizes and a name come first, then as many arrays, of such a length, as they say."""
    if len(parts) < 2 or parts[0][0] != 6 or len(parts[0][1]) != 8:
        raise ValueError("a matrix without flags")
    (flags,) = struct.unpack(f"{order}I", parts[0][1][:4])
    what, is_complex = flags & 0xFF, bool(flags & 0x800)
    if what in _MAT_OPAQUE:
        return
    sizes = parts[1][1]
    if len(parts) < 3 or parts[1][0] not in (5, 6) or len(sizes) < 8 or len(sizes) % 4:
        raise ValueError("a matrix without its sizes or its name")
    count = math.prod(struct.unpack(f"{order}{len(sizes) // 4}i", sizes))
    data = parts[3:]
    if what in (_CELL, _STRUCT, _OBJECT):
        inner = [kind for kind, _ in data if kind == _MATRIX]
        heads = {_CELL: 0, _STRUCT: 2, _OBJECT: 3}[what]
        fields = 1
        if heads and len(data) >= heads and len(data[heads - 2][1]) == 4:
            (width,) = struct.unpack(f"{order}i", data[heads - 2][1])
            fields = len(data[heads - 1][1]) // width if width > 0 else -1
        good = len(data) - heads == len(inner) == count * fields
    elif what in _MAT_ARRAYS:
        sized = what in (4, 5) or all(len(v) == count * _MAT_BYTES.get(k, 0) for k, v in data)
        good = sized and len(data) == _MAT_ARRAYS[what] + is_complex
        good = good and all(kind in (*_MAT_NUMBERS, *_MAT_TEXTS) for kind, _ in data)
    else:
        good = False
    if not good:
        raise ValueError(f"a matrix of class {what} whose arrays are not those of its sizes")
