"""Packages that import what they offer only when it is asked for."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def offered(
    package: str, where: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package whose parts are imported on first use.

    Args:
        package: Full name of the package, such as "diffsim.soft".
        where: Full name of the defining module by offered name; where the two end alike, the module
            itself is offered.

    Returns:
        The two functions, to be bound at the package's top level.
    """

    def get(name: str) -> Any:
        if name not in where:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = importlib.import_module(where[name])
        return module if where[name] == f"{package}.{name}" else getattr(module, name)

    def names() -> list[str]:
        return sorted(where)

    return get, names
