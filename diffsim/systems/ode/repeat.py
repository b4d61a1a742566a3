"""Entries of a description that are written once and hold for each link, cell or tank of a row.

``repeat: {k: 5}`` makes five entries of each one whose name has ``{k}`` in it. In formulas ``{k}``
is the number, ``{k-1}`` and ``{k+1}`` those of the neighbors, so that a sum is written as
``total_{k}: total_{k-1} + mass_{k}``. A list in place of a value has an item for each.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from diffsim.core.check import did_you_mean

SECTIONS = ("states", "rates", "parameters", "define", "tables", "readings", "ranges", "limits")
MOST_REPEATS = 200  # of an entry: its formulas are read and compiled one by one
_INDEX = re.compile(r"\{\s*([A-Za-z_]\w*)\s*([+-]\s*\d+)?\s*\}")


def write_out(given: Any) -> Any:
    """A description with its repeated entries written out; whatever else is given as it is.

    Raises:
        ValueError: an index that ``repeat`` does not state, or a list of another length.
    """
    if not isinstance(given, Mapping) or not isinstance(given.get("repeat"), Mapping):
        return given
    counts = {str(name): count for name, count in given["repeat"].items()}
    for name, count in counts.items():
        is_count = isinstance(count, int) and 1 <= count <= MOST_REPEATS
        if not name.isidentifier() or not is_count:
            raise ValueError(
                f"repeat.{name} must be a name with a number from 1 to {MOST_REPEATS}, got "
                f"{count!r}"
            )
    return {
        key: _write_section(f"{key}", entries, counts)
        if key in SECTIONS and isinstance(entries, Mapping)
        else entries
        for key, entries in given.items()
    }


def _write_section(
    where: str, entries: Mapping[Any, Any], counts: Mapping[str, int]
) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in entries.items():
        name = str(key)
        used = list(dict.fromkeys(found[1] for found in _INDEX.finditer(name)))
        if not used:
            made = {name: value}
        elif len(used) == 1:
            made = _write_entry(f"{where}.{name}", name, value, used[0], counts)
        else:
            raise ValueError(f"{where}.{name}: one index for each entry, got {', '.join(used)}")
        if twice := sorted(out.keys() & made.keys()):
            raise ValueError(f"{where}.{name}: {twice[0]} is stated twice")
        out.update(made)
    return out


def _write_entry(
    where: str, name: str, value: Any, index: str, counts: Mapping[str, int]
) -> dict[str, Any]:
    if index not in counts:
        raise ValueError(f"{where}: repeat states no {index!r}{did_you_mean(index, list(counts))}")
    num = counts[index]
    if isinstance(value, list) and len(value) != num:
        raise ValueError(f"{where}: {len(value)} values, but {index} counts to {num}")
    return {
        _fill(name, index, k): _fill(value[k - 1] if isinstance(value, list) else value, index, k)
        for k in range(1, num + 1)
    }


def _fill(value: Any, index: str, number: int) -> Any:
    """The same with numbers for the index, in whatever text it holds."""
    if isinstance(value, Mapping):
        return {key: _fill(item, index, number) for key, item in value.items()}
    if not isinstance(value, str):
        return value

    def count(found: re.Match[str]) -> str:
        if found[1] != index:
            return found[0]
        return str(number + int((found[2] or "0").replace(" ", "")))

    return _INDEX.sub(count, value)
