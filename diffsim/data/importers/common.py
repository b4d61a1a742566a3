"""Steps that the importers share: metadata, columns of a file, noise of sensors at rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.check import did_you_mean
from diffsim.core.yaml_text import read_yaml_file
from diffsim.data.signal import scatter
from diffsim.data.table import open_table, parse_number

Array = NDArray[np.float64]


def read_metadata(folder: Path) -> dict[str, Any]:
    """``metadata.yaml`` of a data set."""
    content = read_yaml_file(folder / "metadata.yaml")
    if not isinstance(content, dict):
        raise ValueError(f"{folder / 'metadata.yaml'}: must be a mapping")
    return content


def facts(meta: Mapping[str, Any], *, held_out: str, notes: str = "") -> dict[str, Any]:
    """Metadata of a study: source, geometry, material, and why which run is held out."""
    kept = ("title", "source", "sampling", "frame", "geometry", "material", "control", "noise")
    out = {key: meta[key] for key in kept if key in meta}
    return out | {"held_out_because": held_out} | ({"notes": notes} if notes else {})


def read_columns(
    path: Path, numbers: Sequence[str], labels: Sequence[str] = ()
) -> tuple[dict[str, Array], dict[str, list[str]]]:
    """Columns of a file, numeric ones (empty cell: NaN) and text."""
    values: dict[str, list[float]] = {name: [] for name in numbers}
    texts: dict[str, list[str]] = {name: [] for name in labels}
    with open_table(path, "recording") as (header, rows):
        for name in (*numbers, *labels):
            if name not in header:
                raise ValueError(
                    f"{path}: column {name} is missing{did_you_mean(name, header)}; "
                    f"the file has {', '.join(header)}"
                )
        for line, row in rows:
            for name in numbers:
                values[name].append(parse_number(path, line, name, row[header.index(name)]))
            for name in labels:
                texts[name].append(row[header.index(name)].strip())
    return {name: np.array(column) for name, column in values.items()}, texts


def jitter(values: Array) -> Array:
    """Noise sd of slowly moving samples (num_samples, ...): frame-to-frame scatter over sqrt 2.

    A robust estimate (median absolute difference), so that single jumps do not count.
    """
    return scatter(np.diff(values, axis=0), 1)
