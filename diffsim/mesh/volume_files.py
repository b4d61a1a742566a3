"""Content of a volume mesh file as it stands: points, elements, and what is said per element.

GMSH, VTK, Abaqus and Medit are read by meshio, USD by ``diffsim.mesh.usd_files``. Nothing is
checked here but that there is one kind of elements; ``diffsim.mesh.load`` makes a mesh of it.

What compressed VTU files unpack to is counted before a reader takes memory for it.
"""

from __future__ import annotations

import base64
import lzma
import re
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from diffsim.core.arrays import Array, IntArray
from diffsim.core.errors import MeshError
from diffsim.core.files import most_unpacked
from diffsim.core.xml_text import refuse_document_type
from diffsim.mesh.reference import HEX_FROM_VTK

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


MESHIO_FORMATS = {
    ".vtu": "vtu",
    ".vtk": "vtk",
    ".msh": "gmsh",
    ".inp": "abaqus",
    ".mesh": "medit",
}
"""Extension to meshio format; all of them number a hexahedron's nodes as VTK does.

Not .xdmf: meshio needs h5py for it, even to read XML."""

USD_FORMATS = (".usd", ".usda", ".usdc")

_INCLUDE = re.compile(rb"^\s*\*\s*INCLUDE", re.I | re.M)
_BOUNDARY_CELLS = {"vertex", "line", "triangle", "quad"}


@dataclass(frozen=True, eq=False)
class VolumeFile:
    """What a file holds."""

    x: Array  # positions of the nodes, (num_nodes, 3) [unit of the file]
    # node indices, (num_elements, 8) or (num_elements, 4), in this library's order
    elements: IntArray
    # named values of the elements, (num_elements, ...) each
    element_data: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    # indices of the elements of each named group; elements may be in several
    groups: Mapping[str, IntArray] = field(default_factory=dict)
    # names of GMSH's physical groups of volumes, by their tag
    tag_names: Mapping[int, str] = field(default_factory=dict)


def read_meshio(path: Path, file_format: str) -> VolumeFile:
    """Read a file through meshio.

    Args:
        file_format: meshio's name of its format.

    Raises:
        MeshError: it cannot be read, or includes another file; no volume elements; several kinds,
            or such of higher order.
    """
    import meshio

    if file_format == "abaqus" and _INCLUDE.search(path.read_bytes()):  # meshio reads any file
        raise MeshError(f"{path} includes another file, which is not done here; write one file")
    try:
        if file_format == "vtu":
            refuse_document_type(path)
            require_unpacked(path)
        # meshio.read itself prints what is wrong, and ends the program
        content = getattr(meshio, file_format).read(path)
    except (Exception, SystemExit) as error:
        said = str(error) or "it is cut off, or of another kind"
        raise MeshError(f"{path} could not be read as {file_format}: {said}") from error
    kind, chosen = _one_kind(path, content.cells)
    elements = _join_blocks([content.cells[b].data for b in chosen]).astype(np.int64)
    if kind == "hexahedron":
        elements = elements[:, HEX_FROM_VTK]
    x = np.asarray(content.points, np.float64)
    if x.ndim != 2 or x.shape[1] != 3:
        raise MeshError(f"{path} must hold points in three dimensions, got shape {x.shape}")
    data = {
        key: _join_blocks([np.asarray(blocks[b]) for b in chosen])
        for key, blocks in content.cell_data.items()
    }
    sizes = [len(content.cells[b].data) for b in chosen]
    groups = {
        name: _members([members[b] for b in chosen], sizes)
        for name, members in content.cell_sets.items()
        if not name.startswith("gmsh:")  # tags of neighboring surfaces, no elements
    }
    groups = {name: members for name, members in groups.items() if len(members)}
    tags = {int(tag): name for name, (tag, dim) in content.field_data.items() if int(dim) == 3}
    return VolumeFile(x, elements, data, groups, tags)


def _one_kind(path: Path, cells: Sequence[Any]) -> tuple[str, list[int]]:
    """The kind of the volume elements, and the blocks that hold them."""
    counts: dict[str, int] = {}
    for block in cells:
        if block.type not in _BOUNDARY_CELLS and len(block.data):
            counts[block.type] = counts.get(block.type, 0) + len(block.data)
    if not counts:
        found = sorted({block.type for block in cells}) or ["nothing"]
        raise MeshError(f"{path} holds no volume elements, only {', '.join(found)}")
    if len(counts) > 1 or not counts.keys() <= {"tetra", "hexahedron"}:
        raise MeshError(
            f"{path} must hold either tetra or hexahedron elements of first order, got "
            f"{' and '.join(f'{count} {kind}' for kind, count in counts.items())}; export one "
            "kind, or split the others into tetrahedra"
        )
    kind = next(iter(counts))
    return kind, [b for b, block in enumerate(cells) if block.type == kind and len(block.data)]


def _members(blocks: Sequence[Any], sizes: Sequence[int]) -> IntArray:
    """Members of a group as indices of the joined elements."""
    starts = np.cumsum([0, *sizes])[:-1]
    parts = [
        start + np.asarray(block, np.int64)
        for start, block in zip(starts, blocks, strict=True)
        if block is not None
    ]
    return _join_blocks(parts) if parts else np.zeros(0, np.int64)


def _join_blocks(blocks: Sequence[NDArray[Any]]) -> NDArray[Any]:
    return blocks[0] if len(blocks) == 1 else np.concatenate(blocks)
