"""MATLAB files: to version 7 by SciPy, 7.3 (HDF5) by h5py."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from numpy.typing import NDArray

from diffsim.data.formats import hdf5
from diffsim.data.formats.columns import Columns, arrays_of_a_table, flat
from diffsim.data.formats.mat_elements import check_elements

_HDF5 = b"\x89HDF"


def parts(path: Path) -> list[str]:
    """Structs that hold arrays; variables of the file itself are ""."""
    if _is_hdf5(path):
        return hdf5.parts(path, upright=True)
    return [name for name, members in _tables(path).items() if _columns(members)]


def read(path: Path, part: str) -> Columns:
    """Columns of the variables, or of a struct's fields; vectors in rows or columns alike."""
    if not _is_hdf5(path):
        return _columns(_tables(path)[part])
    return hdf5.read(path, part, upright=True)  # MATLAB's (n, 1) comes as (1, n)


def left_out(path: Path, part: str) -> list[str]:
    """Arrays that are none of the table."""
    if _is_hdf5(path):
        return hdf5.left_out(path, part, upright=True)
    return _sorted_out(_tables(path)[part])[1]


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
    content = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)
    variables = {k: v for k, v in content.items() if not k.startswith("__")}
    structs = {
        name: {field: getattr(value, field) for field in value._fieldnames}
        for name, value in variables.items()
        if hasattr(value, "_fieldnames")
    }
    return {"": {k: v for k, v in variables.items() if k not in structs}, **structs}


def _columns(members: Mapping[str, Any]) -> Columns:
    upright, _ = _sorted_out(members)
    return dict(pair for name, values in upright.items() for pair in flat(name, values))


def _sorted_out(members: Mapping[str, Any]) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Arrays with a row per sample, and what is left out."""
    arrays, others = {}, []
    for name, values in members.items():
        is_array = isinstance(values, np.ndarray) and values.dtype.kind in "biufU"
        if is_array and values.ndim in (1, 2):
            wide = values.ndim == 2 and values.shape[0] < values.shape[1]
            arrays[name] = values.T if wide else values
        elif not hasattr(values, "_fieldnames"):
            what = "a single value" if np.ndim(values) == 0 else "no table"
            others.append(f"variable {name}: {what}")
    used, left = arrays_of_a_table({n: v.shape for n, v in arrays.items()}, "variable")
    return {name: arrays[name] for name in used}, [*left, *others]


def word(name: str) -> str:
    """A name as MATLAB has variables: letters, digits and underscores, a letter first."""
    spelled = "".join(c if c.isascii() and c.isalnum() else "_" for c in name)
    return spelled if spelled[:1].isalpha() else f"x{spelled}"
