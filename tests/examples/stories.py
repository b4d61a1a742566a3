"""Examples as modules: they lie outside the package."""

from types import ModuleType

from tests.scripts import ROOT, load_file

EXAMPLES = ROOT / "examples"


def load_story(path: str) -> ModuleType:
    """The example at ``path`` below examples/, such as "stokes/amplifier.py"."""
    file = EXAMPLES / path
    return load_file(file, f"story_{file.stem}")
