"""Paths and names that files state: they stay in their folder, whoever wrote the file.

A link in that folder may have come with the file. It may lead elsewhere only where the user says
so, by ``--links FOLDER`` or the variable ``DIFFSIM_LINKS``, which no file can set.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path, PurePosixPath, PureWindowsPath

LINKS = "DIFFSIM_LINKS"  # folders that links may lead into, divided as PATH is
MAX_NAME = 120  # characters: file systems end at 255 bytes, and suffixes are added
_NOT_IN_NAMES = re.compile(r"[\x00-\x1f\x7f/\\]")


def inside(folder: Path, stated: str, what: str) -> Path:
    """A stated path as a path in a folder.

    Args:
        folder: Folder that the path cannot leave.
        stated: Path as a file states it, relative to the folder.
        what: What states it, for the message, such as "runs[2].file".

    Returns:
        ``folder / stated``; it need not exist.

    Raises:
        ValueError: it is absolute, goes up by ``..``, or leads by a link neither into the folder
            nor into one that the user allows.
    """
    if not stated or "\x00" in stated:
        raise ValueError(f"{what} must name a file, got {stated!r}")
    for form in (PurePosixPath(stated), PureWindowsPath(stated)):
        if form.is_absolute() or form.drive or form.root:
            raise ValueError(
                f"{what} must be a path relative to its folder, got {_quote(stated)}; put the file "
                "into the folder"
            )
        if ".." in form.parts:
            raise ValueError(
                f"{what} must stay in its folder, got {_quote(stated)}, which goes up by '..'; put "
                "the file into the folder"
            )
    path = folder / stated
    try:
        end = path.resolve()
        allowed = [Path(f).expanduser() for f in os.environ.get(LINKS, "").split(os.pathsep) if f]
        stays = any(end.is_relative_to(f.resolve()) for f in (folder, *allowed))
    except (OSError, RuntimeError) as error:  # a circle of links
        raise ValueError(f"{what}: {_quote(stated)} cannot be followed: {error}") from None
    if not stays:
        raise ValueError(
            f"{what} must stay in its folder, but {_quote(stated)} is a link that leaves it; put "
            f"the file itself into the folder, or, if the link is yours: --links {end.parent}"
        )
    return path


def allow_links(folders: Iterable[Path]) -> None:
    """Let links lead into further folders, in this process and in those that it starts.

    Raises:
        ValueError: there is no such folder.
    """
    for folder in folders:
        if not folder.is_dir():
            raise ValueError(f"--links must be an existing folder, got {folder}")
        named = [os.environ.get(LINKS, ""), str(folder.resolve())]
        os.environ[LINKS] = os.pathsep.join(filter(None, named))


def require_file_name(what: str, name: str) -> str:
    """Check that a name can be that of a file or folder, in whatever folder it is put.

    Raises:
        ValueError: it is empty, ``.`` or ``..``, too long, has a separator or a control character.
    """
    if not name.strip() or name.strip(".") == "" or _NOT_IN_NAMES.search(name):
        raise ValueError(
            f"{what} must be a plain name, since files are called by it, got {_quote(name)}; use "
            "letters, digits, spaces, '_', '-' and '.'"
        )
    if len(name) > MAX_NAME:
        raise ValueError(f"{what} must have at most {MAX_NAME} characters, got {len(name)}")
    return name


def _quote(text: str) -> str:
    return repr(text if len(text) <= MAX_NAME else text[:MAX_NAME] + "...")
