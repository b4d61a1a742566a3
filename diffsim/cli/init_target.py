"""What a first study is refused for at once: nothing here loads PyTorch."""

from __future__ import annotations

from pathlib import Path

STUDY_FILE = "study.yaml"


def require_target(folder: Path, out: Path | None, *, force: bool) -> Path:
    """The file to be written.

    Args:
        out: File as given; None: ``study.yaml`` in the folder.
        force: Whether a file that is there is replaced.

    Raises:
        FileNotFoundError: no such folder.
        FileExistsError: the file is there, and ``force`` is not given.
        ValueError: nothing is in the folder.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; give the folder of your recordings")
    out = out or folder / STUDY_FILE
    if out.exists() and not force:
        raise FileExistsError(f"{out} is there already; --force replaces it")
    if not any(folder.iterdir()):
        raise ValueError(f"{folder} is empty; put your recordings there, one file a run")
    return out
