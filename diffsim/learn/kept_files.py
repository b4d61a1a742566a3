"""Files of the controllers that come with the package: what they say of themselves.

Needs no package but NumPy, so that they can be listed where nothing can be played.
"""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

FOLDER = Path(str(files("diffsim.learn"))) / "controllers"
ABOUT = "about"  # entry of a file: all but the weights, as JSON


def trained_names() -> list[str]:
    """Names of the controllers that come with the package."""
    return sorted(path.stem for path in FOLDER.glob("*.npz"))


def about(name: str) -> dict[str, Any]:
    """What a controller's file says of it: ``reward`` a step, ``made_by`` and the like.

    Args:
        name: One of ``trained_names``.
    """
    with np.load(FOLDER / f"{name}.npz", allow_pickle=False) as content:
        said: dict[str, Any] = json.loads(str(content[ABOUT]))
    return said
