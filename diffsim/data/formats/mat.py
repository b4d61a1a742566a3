"""MATLAB files: to version 7 by SciPy, 7.3 (HDF5) by h5py."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from numpy.typing import NDArray

from diffsim.data.formats import hdf5
from diffsim.data.formats.columns import Columns, flat
from diffsim.data.formats.hdf5 import with_equal_lengths

_HDF5 = b"\x89HDF"


def parts(path: Path) -> list[str]:
    """Structs that hold arrays; variables of the file itself are ""."""
    if _is_hdf5(path):
        return [name for name in hdf5.parts(path) if not name.startswith("#")]
    return [name for name, members in _tables(path).items() if _columns(members)]


def read(path: Path, part: str) -> Columns:
    """Columns of the variables, or of a struct's fields; vectors in rows or columns alike."""
    if not _is_hdf5(path):
        return _columns(_tables(path)[part])
    columns = hdf5.read(path, part)  # MATLAB's (1, n) and (n, 1) come as (n, 1) and (1, n)
    return {name.removesuffix("[0]"): values for name, values in columns.items()}


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
    content = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)
    variables = {k: v for k, v in content.items() if not k.startswith("__")}
    structs = {
        name: {field: getattr(value, field) for field in value._fieldnames}
        for name, value in variables.items()
        if hasattr(value, "_fieldnames")
    }
    return {"": {k: v for k, v in variables.items() if k not in structs}, **structs}


def _columns(members: Mapping[str, Any]) -> Columns:
    arrays = {
        name: values
        for name, values in members.items()
        if isinstance(values, np.ndarray) and values.ndim in (1, 2) and values.dtype.kind in "biufU"
    }
    upright = {n: v.T if v.ndim == 2 and v.shape[0] < v.shape[1] else v for n, v in arrays.items()}
    columns = dict(pair for name, values in upright.items() for pair in flat(name, values))
    return with_equal_lengths(columns)


def word(name: str) -> str:
    """A name as MATLAB has variables: letters, digits and underscores, a letter first."""
    spelled = "".join(c if c.isascii() and c.isalnum() else "_" for c in name)
    return spelled if spelled[:1].isalpha() else f"x{spelled}"
