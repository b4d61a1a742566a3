"""Published data sets: where they come from, under which licence, and the sums of their files."""

from __future__ import annotations

import hashlib
import urllib.error
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

import yaml

from diffsim.core.check import did_you_mean
from diffsim.core.errors import DiffsimError
from diffsim.core.files import write_bytes_atomic

TABLE = "published_sets.yaml"
PATIENCE_S = 30.0  # of a connection without an answer


class DataSetError(DiffsimError):
    """A data set that cannot be had, or is not what was described."""


@dataclass(frozen=True, kw_only=True)
class PublishedSet:
    """A data set that studies of this package read."""

    name: str  # folder name, such as ``emps``
    source: str  # address of the repository that published the measurements
    commit: str  # version of it
    licence: str  # what the authors state
    files: Mapping[str, tuple[str, int]]  # SHA-256 and size in bytes of every table, by name
    # whether some tables are made from a clone, as nobody may hand them on: ``make_csv.py`` in the
    # folder, whose README names the clones. Such tables have no sum here.
    made: bool = False

    @property
    def words(self) -> str:
        """Where it comes from and what one may do with it, in two sentences."""
        from_where = f"{self.name}: from {self.source}, commit {self.commit}"
        return f"{from_where}. Licence: {self.licence}."


@cache
def published_sets() -> Mapping[str, PublishedSet]:
    """All data sets by name."""
    table = yaml.safe_load((files("diffsim.data") / TABLE).read_text("utf-8"))
    return {
        name: PublishedSet(
            name=name,
            **{
                **row,
                "files": {f: (digest, int(size)) for f, (digest, size) in row["files"].items()},
            },
        )
        for name, row in table.items()
    }


def published_set(name: str) -> PublishedSet:
    """A data set by name.

    Args:
        name: Folder name, such as ``emps``.

    Raises:
        ValueError: no published data set has this name.
    """
    known = published_sets()
    if name not in known:
        raise ValueError(
            f"no published data set is called {name}{did_you_mean(name, known)}; "
            f"there are {', '.join(known)}"
        )
    return known[name]


def differing(known: PublishedSet, folder: Path) -> list[str]:
    """Files of a data set that a folder lacks, or holds with other contents."""
    return [
        name
        for name, (digest, _) in known.files.items()
        if not (folder / name).is_file() or _sum((folder / name).read_bytes()) != digest
    ]


def get_set(known: PublishedSet, folder: Path, address: str) -> list[str]:
    """Fetch what a folder lacks of a data set; nothing is kept whose sum differs.

    Args:
        folder: Its folder; made where it is missing.
        address: Folder of data sets on this machine, or its http address.

    Returns:
        Names of the files that were fetched.

    Raises:
        DataSetError: the address cannot be reached, or a file there is another one.
    """
    wanted = differing(known, folder)
    for name in wanted:
        digest, size = known.files[name]
        content = _read(f"{address.rstrip('/')}/{known.name}/{name}", size)
        if (got := _sum(content)) != digest:
            raise DataSetError(
                f"{address}/{known.name}/{name} is not the file of this study: "
                f"SHA-256 {got[:12]}..., expected {digest[:12]}...; nothing of it is kept"
            )
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_bytes_atomic(folder / name, content)
    return wanted


def _read(place: str, size: int) -> bytes:
    """A file of a folder or an address; no more than a byte above its size."""
    try:
        if not place.startswith(("https://", "http://")):
            return Path(place).expanduser().read_bytes()
        with urllib.request.urlopen(place, timeout=PATIENCE_S) as answer:
            content: bytes = answer.read(size + 1)
            return content
    except (urllib.error.URLError, TimeoutError, OSError) as error:
        why = getattr(error, "reason", None) or getattr(error, "strerror", None) or error
        raise DataSetError(
            f"{place} cannot be read ({why}); without a connection, copy the folder from a machine "
            "that has it and name it: --from FOLDER"
        ) from None


def _sum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
