"""Optional packages, imported when needed, with a message that says how to get them."""

from __future__ import annotations

import importlib
from types import ModuleType


def optional(module: str, *, purpose: str, extra: str = "viz") -> ModuleType:
    """Import ``module`` or say what it is for and how to install it.

    Raises:
        ImportError: the package is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise ImportError(
            f"{purpose} needs {package}, which is not installed; "
            f"pip install 'diffsim-robot[{extra}]'"
        ) from error
