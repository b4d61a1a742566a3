"""Studies made from published recordings, by the name of their data set.

Each importer states which run is held out and why, and what of the set-up is known; what a data
set lacks for a diagnosis says :func:`diffsim.data.check_study`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from diffsim.core.check import require_choice
from diffsim.data.importers.silicone_beam import import_silicone_beam
from diffsim.data.importers.starfish import import_starfish
from diffsim.data.recording import find_dataset
from diffsim.data.study import Study

#: Name of the study -> folder of the data set, function that reads it.
IMPORTERS: dict[str, tuple[str, Callable[[Path], Study]]] = {
    "silicone_beam": ("silicone_beam", import_silicone_beam),
    "starfish": ("starfish", import_starfish),
}


def import_study(name: str, data: str | Path | None = None) -> Study:
    """The study of a published data set.

    Args:
        name: Name of the data set, a key of ``IMPORTERS``.
        data: Folder that holds the data sets; by default as :func:`diffsim.data.find_dataset`.

    Raises:
        ValueError: unknown name.
        FileNotFoundError: the data is not there.
    """
    folder_name, read = IMPORTERS[require_choice("name", name, IMPORTERS)]
    folder = find_dataset(folder_name, data)
    if folder is None:
        raise FileNotFoundError(
            f"no folder {folder_name} with measured data; give data= or set DIFFSIM_DATA to the "
            "folder that holds it"
        )
    return read(folder)


__all__ = ["IMPORTERS", "import_silicone_beam", "import_study"]
