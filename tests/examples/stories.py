"""Examples as modules: they lie outside the package."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def load_story(path: str) -> ModuleType:
    """The example at ``path`` below examples/, such as "stokes/amplifier.py"."""
    file = EXAMPLES / path
    name = f"story_{file.stem}"
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module
