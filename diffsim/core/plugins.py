"""What other packages add to this one, by entry points: environments, devices, systems.

A package that is installed beside this one names, in its ``pyproject.toml``::

    [project.entry-points."diffsim.environments"]
    EelSwim = "my_package.tasks:EelSwim"

Nothing of it is imported before it is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import MappingProxyType
from typing import Any

ENVIRONMENTS, DEVICES, SYSTEMS = "diffsim.environments", "diffsim.devices", "diffsim.systems"


@cache
def find_plugins(group: str) -> Mapping[str, EntryPoint]:
    """Entry points of a group by name.

    Args:
        group: One of ``ENVIRONMENTS``, ``DEVICES``, ``SYSTEMS``.

    Raises:
        ValueError: two packages that are installed give one name.
    """
    found: dict[str, EntryPoint] = {}
    for entry in entry_points(group=group):
        other = found.setdefault(entry.name, entry)
        if other.value != entry.value:
            raise ValueError(
                f"{group}: {entry.name!r} is {other.value} and {entry.value}; uninstall one of the "
                "packages, or rename it in its pyproject.toml"
            )
    return MappingProxyType(found)


def load_plugin(group: str, name: str, kind: type, *, or_file: bool = False) -> Any:
    """What another package adds under a name.

    Args:
        group: Group of entry points.
        name: Name of the entry.
        kind: Class that it must be a subclass of; ``object``: any callable.
        or_file: Whether it may be the path of a YAML file instead, which describes one.

    Raises:
        ValueError: it cannot be imported, or is something else; the message names the package.
    """
    entry = find_plugins(group)[name]
    package = entry.dist.name if entry.dist is not None else "another package"
    where = f"{group}: {name} = {entry.value} of {package}"
    try:
        made = entry.load()
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{where} cannot be imported: {error}") from error
    if or_file and isinstance(made, (str, Path)) and Path(made).suffix in (".yaml", ".yml"):
        return Path(made)
    is_kind = isinstance(made, type) and issubclass(made, kind) if kind is not object else True
    if not is_kind or not callable(made):
        more = ", or the path of a YAML file" if or_file else ""
        raise ValueError(f"{where} must be a subclass of {kind.__name__}{more}, got {made!r}")
    return made
