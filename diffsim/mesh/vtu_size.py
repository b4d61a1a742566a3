"""Compressed VTU files: what they unpack to, counted before a reader takes memory for it."""

from __future__ import annotations

import base64
import lzma
import re
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Protocol
from xml.etree import ElementTree

import numpy as np

from diffsim.core.files import most_unpacked

MOST_UNPACKED = 100_000_000  # bytes, of a small file: a million hexahedra
_MOST_MEMORY = 100_000_000  # bytes, of LZMA's dictionary
_STEP = 1_000_000  # bytes that are unpacked at once
_SIZES = {"UInt32": "u4", "UInt64": "u8"}  # of the numbers in front of an array's blocks
_APPENDED = re.compile(rb"<AppendedData[^>]+>")


class _Unpacker(Protocol):
    @property
    def eof(self) -> bool: ...
    @property
    def unused_data(self) -> bytes: ...
    def decompress(self, data: bytes, max_length: int, /) -> bytes: ...


_UNPACKERS: dict[str, Callable[[], _Unpacker]] = {
    "vtkZLibDataCompressor": zlib.decompressobj,
    "vtkLZMADataCompressor": lambda: lzma.LZMADecompressor(memlimit=_MOST_MEMORY),
}


def require_unpacked(path: Path) -> None:
    """Refuse a compressed file whose arrays have more bytes than its size lets one expect.

    Args:
        path: A VTU file without a document type.

    Raises:
        ValueError: it unpacks to more than 100 MB, and more than 50 times its size; or it says of
            a block that it is longer than the file.
    """
    _, root = next(iter(ElementTree.iterparse(path, events=("start",))))
    unpacker = _UNPACKERS.get(root.get("compressor", ""))
    if unpacker is None:
        return  # nothing is packed, or by what is unknown to the reader too
    left = most = most_unpacked(path, MOST_UNPACKED)
    for block in _packed_blocks(path):
        for length in _lengths(block, unpacker):
            left -= length
            if left < 0:
                raise ValueError(f"it unpacks to more than {most:,} bytes, which are not read")


def _packed_blocks(path: Path) -> Iterator[bytes]:
    """Packed blocks of all arrays, in base64 or as they are behind the elements."""
    raw = b""
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError:
        content = path.read_bytes()
        begin, end = _APPENDED.search(content), content.rfind(b"</AppendedData>")
        if begin is None or end < begin.end():
            raise
        root = ElementTree.fromstring(content[: begin.end()] + content[end:])
        raw = content[begin.end() : end].partition(b"_")[2]
    order = ">" if root.get("byte_order") == "BigEndian" else "<"
    header = np.dtype(order + _SIZES.get(root.get("header_type", "UInt32"), "u4"))
    appended = (root.findtext("AppendedData") or "").strip()[1:]
    for array in root.iter("DataArray"):
        kind, at = array.get("format"), int(array.get("offset") or 0)
        if raw and array.get("offset"):  # the reader asks for no format there
            yield from _blocks(partial(_part, raw, at), header)
        elif kind in ("appended", "binary"):
            text = appended[at:] if kind == "appended" else (array.text or "").strip()
            yield from _blocks(_from_base64(text, header), header)


def _part(raw: bytes, at: int, first: int, num: int) -> bytes:
    return raw[at + first : at + first + num]


def _from_base64(text: str, header: np.dtype) -> Callable[[int, int], bytes]:
    """Bytes of an array: its header and its blocks are encoded one after the other."""
    count = _numbers(base64.b64decode(text[: _letters(header.itemsize)]), header, 1)[0]
    size = header.itemsize * (3 + count)

    def of(first: int, num: int) -> bytes:
        if first < size:
            return base64.b64decode(text[: _letters(size)])[first : first + num]
        start = (first - size) // 3
        letters = text[_letters(size) :][4 * start : 4 * start + _letters(num + 3)]
        return base64.b64decode(letters)[first - size - 3 * start :][:num]

    return of


def _blocks(of: Callable[[int, int], bytes], header: np.dtype) -> Iterator[bytes]:
    """Blocks of an array: the count, two sizes before packing, and the size of each come first.

    Args:
        of: Bytes of the array, from one on, so many.
        header: Kind of its numbers.
    """
    count = _numbers(of(0, header.itemsize), header, 1)[0]
    first = header.itemsize * (3 + count)
    for size in _numbers(of(3 * header.itemsize, header.itemsize * count), header, count):
        yield of(first, size)
        first += size


def _numbers(content: bytes, header: np.dtype, count: int) -> list[int]:
    if len(content) < count * header.itemsize:
        raise ValueError(f"an array says that it has {count} blocks, and is cut off before")
    return [int(number) for number in np.frombuffer(content, header, count)]


def _letters(size: int) -> int:
    """Letters of base64 for so many bytes."""
    return 4 * -(-size // 3)


def _lengths(packed: bytes, unpacker: Callable[[], _Unpacker]) -> Iterator[int]:
    """Bytes that a block unpacks to, as many at once as one may hold."""
    while packed:
        stream = unpacker()
        while not stream.eof:
            out = stream.decompress(packed, _STEP)
            yield len(out)
            packed = getattr(stream, "unconsumed_tail", b"")  # LZMA keeps it
            if not out and not packed and not stream.eof:
                return  # cut off, which the reader says
        packed = stream.unused_data
