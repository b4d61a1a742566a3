"""Compressed VTU files are counted before they take memory, wherever their arrays stand."""

import base64
import lzma
import re
import struct
import zlib

import numpy as np
import pytest
import torch

from diffsim import mesh
from diffsim.core import MeshError
from diffsim.mesh import volume_files

PACK = {"vtkZLibDataCompressor": zlib.compress, "vtkLZMADataCompressor": lzma.compress}
PLACES = ["binary", "base64", "raw"]


def packed(values, pack, header, blocks=2):
    """Header and blocks of an array, as VTK writes them."""
    content = values.tobytes()
    size = -(-len(content) // blocks // 8) * 8
    parts = [pack(content[k * size : (k + 1) * size]) for k in range(blocks)]
    numbers = [blocks, size, len(content) - (blocks - 1) * size, *map(len, parts)]
    return struct.pack(f"<{len(numbers)}{header}", *numbers), b"".join(parts)


def write(path, points, *, compressor, place, header="I"):
    """A tetrahedron with points in a compressed array; the others are packed beside it or text."""
    arrays = {
        ("Points", "Float64", 3): points,
        ("connectivity", "Int64", 1): np.arange(4),
        ("offsets", "Int64", 1): np.array([4]),
        ("types", "UInt8", 1): np.array([10], np.uint8),
    }
    texts, behind = {}, b""
    for (name, kind, num), values in arrays.items():
        front, body = packed(values, PACK[compressor], header, 1 if values.size < 9 else 2)
        encoded = base64.b64encode(front) + base64.b64encode(body)
        where = (
            'format="binary"' if place == "binary" else f'format="appended" offset="{len(behind)}"'
        )
        behind += encoded if place == "base64" else front + body
        inside = encoded.decode() if place == "binary" else ""
        texts[name] = (
            f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{num}" {where}>'
            f"{inside}</DataArray>"
        )
    cells = "".join(texts[name] for name in ("connectivity", "offsets", "types"))
    cells = cells.replace(' NumberOfComponents="1"', "")
    whole = (
        f'<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" '
        f'header_type="UInt{64 if header == "Q" else 32}" compressor="{compressor}">'
        f'<UnstructuredGrid><Piece NumberOfPoints="{len(points)}" NumberOfCells="1"><Points>'
        f"{texts['Points']}</Points><Cells>{cells}</Cells></Piece></UnstructuredGrid>"
    ).encode()
    if place != "binary":
        whole += f'<AppendedData encoding="{place}">_'.encode() + behind + b"\n</AppendedData>"
    path.write_bytes(whole + b"</VTKFile>")


@pytest.mark.parametrize("header", ["I", "Q"])
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("compressor", PACK)
def test_whole_files_are_read_and_counted_to_the_byte(tmp_path, compressor, place, header):
    path = tmp_path / "a.vtu"
    points = np.concatenate([np.zeros((1, 3)), np.eye(3), np.random.default_rng(0).random((9, 3))])
    write(path, points, compressor=compressor, place=place, header=header)
    assert torch.equal(mesh.load_arrays(path)[0], torch.from_numpy(points))
    unpacker = volume_files._UNPACKERS[compressor]
    lengths = [
        n
        for block in volume_files._packed_blocks(path)
        for n in volume_files._lengths(block, unpacker)
    ]
    assert sum(lengths) == points.nbytes + 4 * 8 + 8 + 1


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("compressor", [*PACK, "vtkZLib&#68;ataCompressor"])
def test_what_unpacks_to_too_much_is_refused(tmp_path, monkeypatch, compressor, place):
    """500 MB of zeros in 650 kB took 1.2 GB, and then a sentence of something else."""
    monkeypatch.setattr(volume_files, "MOST_UNPACKED", 10**6)  # a hundredth, for the time it takes
    path = tmp_path / "a.vtu"
    plain = compressor.replace("&#68;", "D")
    write(path, np.zeros((10**5, 3)), compressor=plain, place=place)
    path.write_bytes(path.read_bytes().replace(plain.encode(), compressor.encode()))
    with pytest.raises(MeshError, match=r"a.vtu .* unpacks to more than 1,000,000 bytes"):
        mesh.load_arrays(path)


def test_streams_of_lzma_behind_each_other_all_count(tmp_path, monkeypatch):
    monkeypatch.setattr(volume_files, "MOST_UNPACKED", 10**6)
    monkeypatch.setitem(
        PACK, "vtkLZMADataCompressor", lambda some: 9 * lzma.compress(b"\0" * 10**5)
    )
    write(tmp_path / "a.vtu", np.zeros((30, 3)), compressor="vtkLZMADataCompressor", place="binary")
    with pytest.raises(MeshError, match="unpacks to more than"):
        mesh.load_arrays(tmp_path / "a.vtu")


@pytest.mark.parametrize("count", [2**31, 3])
def test_headers_that_claim_blocks_are_refused(tmp_path, count):
    path = tmp_path / "a.vtu"
    write(path, np.eye(4, 3), compressor="vtkZLibDataCompressor", place="binary")
    wrong = base64.b64encode(struct.pack("<4I", count, 8, 8, 8))
    path.write_bytes(
        re.sub(rb'(format="binary">)[^<]*', rb"\1" + wrong, path.read_bytes(), count=1)
    )
    with pytest.raises(MeshError, match=f"it has {count} blocks, and is cut off before"):
        mesh.load_arrays(path)
