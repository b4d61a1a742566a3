"""MATLAB files: to version 7 by SciPy, 7.3 (HDF5) by h5py.

SciPy's reader trusts what elements of version 5 say of themselves: a damaged kind, flag or size
ends the process, so they are held against it before. An element is a kind, a size and so many
bytes; a matrix holds others (MathWorks, MAT-File Format, ch. 1).
"""

from __future__ import annotations

import math
import struct
import warnings
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from numpy.typing import NDArray

from diffsim.data.formats import hdf5
from diffsim.data.formats.columns import Columns, arrays_of_a_table, flat, most_unpacked

_HDF5 = b"\x89HDF"
_OBJECTS = (
    "objects of MATLAB (a table, timetable, timeseries or string), which it alone reads: there, "
    "`writetable(T, 'run.csv')` or `save` of their columns makes files that can be read"
)


def parts(path: Path) -> list[str]:
    """Structs that hold arrays; variables of the file itself are ""."""
    if _is_hdf5(path):
        return hdf5.parts(path, upright=True)
    return [name for name, members in _of_one_clock(_tables(path)).items() if _columns(members)]


def read(path: Path, part: str) -> Columns:
    """Columns of the variables, or of a struct's fields; vectors in rows or columns alike."""
    if not _is_hdf5(path):
        return _columns(_members(path, part))
    return hdf5.read(path, part, upright=True)  # MATLAB's (n, 1) comes as (1, n)


def left_out(path: Path, part: str) -> list[str]:
    """Arrays that are none of the table."""
    if _is_hdf5(path):
        return hdf5.left_out(path, part, upright=True)
    return _sorted_out(_members(path, part))[1]


def write(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write each column as a variable; names become MATLAB's."""
    names = {name: word(name) for name in columns}
    if len(set(names.values())) < len(names):
        raise ValueError(f"two columns have the same name in MATLAB: {', '.join(names)}")
    scipy.io.savemat(
        path, {names[name]: values for name, values in columns.items()}, oned_as="column"
    )


def _is_hdf5(path: Path) -> bool:
    with path.open("rb") as file:
        start = file.read(516)
    return start[:4] == _HDF5 or start[512:516] == _HDF5


def _tables(path: Path) -> dict[str, dict[str, Any]]:
    check_elements(path)
    with warnings.catch_warnings():  # objects share the name None, where SciPy tells them
        warnings.simplefilter("ignore", scipy.io.matlab.MatReadWarning)
        content = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)
    variables = {k: v for k, v in content.items() if not k.startswith("__")}
    structs = {
        name: _with_signals(name, value)
        for name, value in variables.items()
        if hasattr(value, "_fieldnames")
    }
    many = _structs_in_arrays(variables)
    used = {*structs, *(name.partition("(")[0] for name in many)}
    rest = {k: v for k, v in variables.items() if k not in used}
    cells = {} if _columns(rest) else _runs_in_cells(variables)  # a few beside a table are none
    return {"": rest, **structs, **many, **cells}


def _members(path: Path, part: str) -> dict[str, Any]:
    """What a part holds; structs that are one table with others are parts by their names, too."""
    tables = _tables(path)
    return _of_one_clock(tables).get(part) or tables[part]


def has_part(path: Path, part: str) -> bool:
    """Whether a file has a part that it does not list: a struct that is in its table."""
    return not _is_hdf5(path) and bool(_columns(_tables(path).get(part, {})))


def _structs_in_arrays(variables: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Each struct of an array of structs, ``runs(3)``, as MATLAB writes it."""
    out = {}
    for name, value in variables.items():
        if _is_cells(value) and all(hasattr(one, "_fieldnames") for one in value):
            for k, one in enumerate(value, 1):
                out[f"{name}({k})"] = _with_signals(name, one)
    return out


def _is_cells(value: Any) -> bool:
    """Whether a variable is a row of things, as cells and arrays of structs come."""
    is_array = isinstance(value, np.ndarray) and value.dtype == object
    return is_array and value.ndim == 1 and len(value) > 0


def _runs_in_cells(variables: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Runs of cells: the k-th cells of arrays with as many samples in each are columns of run k."""
    groups: dict[tuple[int, ...], dict[str, NDArray[Any]]] = {}
    for name, value in variables.items():
        if _is_cells(value) and all(_is_sampled(cell) for cell in value):
            groups.setdefault(tuple(max(cell.shape) for cell in value), {})[name] = value
    return {
        f"{next(iter(group))}({k + 1})": {name: cells[k] for name, cells in group.items()}
        for lengths, group in groups.items()
        for k in range(len(lengths))
    }


def _is_sampled(cell: Any) -> bool:
    """Whether a cell holds numbers with a row or a column for each sample."""
    is_array = isinstance(cell, np.ndarray) and cell.dtype.kind in "biuf"
    return is_array and cell.ndim in (1, 2) and max(cell.shape) > 1


def _of_one_clock(tables: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Structs of the same stamps and other columns are one table: signals that Simulink saved.
    Names that count, run1 and run2, are those of runs."""
    if any(_columns(own) for name, own in tables.items() if "time" not in own):
        return tables
    timed = {name: own for name, own in tables.items() if np.ndim(own.get("time", 0.0)) == 1}
    names = [key for own in timed.values() for key in own if key != "time"]
    stamps = [own["time"] for own in timed.values()]
    stems = {name.rstrip("0123456789") for name in timed}
    if len(timed) < 2 or len(set(names)) < len(names) or len(stems) == 1:
        return tables
    if not all(np.array_equal(stamps[0], other) for other in stamps):
        return tables
    return {"": {key: values for own in timed.values() for key, values in own.items()}}


def _with_signals(name: str, struct: Any) -> dict[str, Any]:
    """Fields of a struct; with time of Simulink each of its signals by its label, else by its
    block; one that has neither by the struct's name."""
    members = {field: getattr(struct, field) for field in struct._fieldnames}
    if {"X", "Y"} <= members.keys():
        return _of_dspace(members)
    signals = np.atleast_1d(members.get("signals", np.empty(0, dtype=object)))
    if "time" not in members or not all(hasattr(one, "values") for one in signals):
        return members
    out = {key: value for key, value in members.items() if key not in ("signals", "blockName")}
    for k, one in enumerate(signals, 1):
        texts = (getattr(one, field, "") for field in ("label", "blockName"))
        label, block = (t.strip() if isinstance(t, str) else "" for t in texts)  # empty: an array
        own = label or block.rpartition("/")[2] or (f"signal_{k}" if k > 1 else name)
        out[f"{own}_{k}" if own in out else own] = one.values
    return out


def _of_dspace(members: dict[str, Any]) -> dict[str, Any]:
    """A capture of dSPACE: the first axis is the clock, each signal is called by its last word."""
    axes, signals = (np.atleast_1d(members[name]) for name in ("X", "Y"))
    if not all(hasattr(one, "Data") and hasattr(one, "Name") for one in (*axes, *signals)):
        return members
    out: dict[str, Any] = {"time": axes[0].Data}
    for k, one in enumerate(signals, 1):
        name = str(one.Name).replace("\\", "/").rpartition("/")[2].strip(' "{}') or f"Y_{k}"
        out[f"{name}_{k}" if name in out else name] = one.Data
    return out


def _columns(members: Mapping[str, Any]) -> Columns:
    upright, _ = _sorted_out(members)
    return dict(pair for name, values in upright.items() for pair in flat(name, values))


def _sorted_out(members: Mapping[str, Any]) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Arrays with a row per sample, and what is left out."""
    arrays, others, single = {}, [], []
    for name, values in members.items():
        is_array = isinstance(values, np.ndarray) and values.dtype.kind in "biufU"
        if is_array and values.ndim in (1, 2):
            wide = values.ndim == 2 and values.shape[0] < values.shape[1]
            arrays[name] = values.T if wide else values
        elif isinstance(values, scipy.io.matlab.MatlabOpaque):
            others.append(_OBJECTS)
        elif np.ndim(values) == 0 and not hasattr(values, "_fieldnames"):
            single.append(f"{name} {_words_of(values)}")
        elif not hasattr(values, "_fieldnames"):
            others.append(f"variable {name}: no table")
    if single:
        what = "variable {}: a single value" if len(single) == 1 else "variables {}: single values"
        others.append(what.format(", ".join(single)))
    used, left = arrays_of_a_table({n: v.shape for n, v in arrays.items()}, "variable")
    return {name: arrays[name] for name in used}, [*left, *others]


def _words_of(value: Any) -> str:
    """A single value in messages: most are facts of the rig, and no column has them."""
    number = np.asarray(value)
    return f"{number.item():.6g}" if number.dtype.kind in "iuf" else f"{value!s:.40}"


def word(name: str) -> str:
    """A name as MATLAB has variables: letters, digits and underscores, a letter first."""
    spelled = "".join(c if c.isascii() and c.isalnum() else "_" for c in name)
    return spelled if spelled[:1].isalpha() else f"x{spelled}"


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
    content, most = memoryview(path.read_bytes()), most_unpacked(path)
    order = {b"IM": "<", b"MI": ">"}.get(bytes(content[126:_MAT_HEADER]))
    if order is not None and 0 not in content[:4]:  # else version 4, read without such
        _walk_elements(content[_MAT_HEADER:], order, 0, most)


def _walk_elements(content: memoryview, order: str, depth: int, most: int) -> None:
    if depth > _MAT_DEPTH:
        raise ValueError(f"more than {_MAT_DEPTH} matrices inside of each other")
    for kind, inner in _elements(content, order):
        if kind == _COMPRESSED:
            unpacked = zlib.decompressobj()
            whole = unpacked.decompress(inner, most)
            if unpacked.unconsumed_tail:
                raise ValueError(f"it unpacks to more than {most:,} bytes")
            if not unpacked.eof:
                raise ValueError("it is cut off")
            _walk_elements(memoryview(whole), order, depth + 1, most)
        elif kind == _MATRIX and len(inner):
            _walk_elements(inner, order, depth + 1, most)
            _check_matrix(list(_elements(inner, order)), order)


def _elements(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
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
