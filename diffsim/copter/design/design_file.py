"""Designs as YAML files; ``diffsim.copter.design.spec_file`` has the schema."""

from __future__ import annotations

from pathlib import Path

from diffsim.copter._shipped import read_named
from diffsim.copter.design.design import Design, build_design
from diffsim.copter.design.spec_file import spec_from_text
from diffsim.core.checked import checked
from diffsim.core.errors import MeshError


@checked
def load_design(name: str | Path) -> Design:
    """Read and compose a design.

    Args:
        name: Name of a shipped design, such as ``pentacopter``, or the path of a YAML file.

    Raises:
        FileNotFoundError: a path without a file.
        ValueError: unknown name, key or value; names file, line and key.
        InfeasibleDesignError: constraints that exclude each other.
    """
    return design_from_text(*read_named("design/designs", "design", name))


def design_from_text(text: str, source: str = "design", folder: Path | None = None) -> Design:
    """Compose a design from YAML text.

    Args:
        text: YAML in the schema of ``diffsim.copter.design.spec_file``.
        source: What error messages call it.
        folder: Folder of the files that the text names.
    """
    spec = spec_from_text(text, source, folder)
    try:
        return build_design(spec)
    except MeshError:
        raise
    except (ValueError, TypeError) as error:
        raise ValueError(f"{source}: {error}") from error


@checked
def save_design(design: Design, path: str | Path) -> Path:
    """Write a design with its current values, atomically."""
    return design.save(path)
