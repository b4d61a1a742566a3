"""Where published recordings lie on this machine."""

from __future__ import annotations

import os
from pathlib import Path

from diffsim.core.check import did_you_mean
from diffsim.core.paths import data_candidates


def find_dataset(name: str, data: str | Path | None = None) -> Path | None:
    """Folder of a data set: under ``data``, else DIFFSIM_DATA, else the folders of ``_paths``.

    Args:
        name: Folder name, such as ``silicone_beam``.
        data: Folder that holds the data sets (or the data set's own folder). When given, or when
            DIFFSIM_DATA is set, nothing else is searched: a typing error must not silently lead
            to other data.

    Returns:
        The folder, or None if none was asked for and none was found.

    Raises:
        FileNotFoundError: ``data`` or DIFFSIM_DATA was given but does not hold the set.
    """
    asked = [("data", data)] if data is not None else []
    if not asked and (from_env := os.environ.get("DIFFSIM_DATA")):
        asked = [("DIFFSIM_DATA", from_env)]
    for label, value in asked:
        base = Path(str(value)).expanduser()
        for folder in (base / name, base):
            if (folder / "metadata.yaml").is_file() and (folder is not base or base.name == name):
                return folder
        has = sorted(p.name for p in base.iterdir() if p.is_dir()) if base.is_dir() else None
        state = "does not exist" if has is None else f"holds {', '.join(has) or 'no folders'}"
        raise FileNotFoundError(
            f"{label}={base} must be the folder that holds {name}/metadata.yaml; it {state}"
            f"{did_you_mean(name, has or [])}"
        )
    folders = (base / name for base in data_candidates())
    return next((folder for folder in folders if (folder / "metadata.yaml").is_file()), None)
