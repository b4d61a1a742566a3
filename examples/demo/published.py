"""The published study of the beam: its description, and its recordings wherever they lie."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

import diffsim
from diffsim.core.files import write_text_atomic
from diffsim.data import Study, load_study

FILE = Path(diffsim.__file__).parent / "systems/published/silicone_beam.yaml"


def described_body() -> dict[str, Any]:
    """The described body, ``model`` of the study."""
    return dict(yaml.safe_load(FILE.read_text(encoding="utf-8"))["model"])


def write_study(recordings: Path, out: Path) -> Study:
    """The published study of recordings in a folder, written so that it can be diagnosed again.

    Args:
        recordings: Folder with the recordings of the beam.
        out: Folder for ``study.yaml``.
    """
    named = f"\ndata: {json.dumps(str(recordings.resolve()))}\n"
    text = FILE.read_text(encoding="utf-8").replace("\ndata: silicone_beam\n", named)
    return load_study(write_text_atomic(out / "study.yaml", text))
