"""Effects that make numbers of a scene larger."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from torch import Tensor

from diffsim.data.study import Run


def adding(*numbers: str) -> Callable[[Any, Tensor, Run], Any]:
    """An effect's ``apply`` that adds its sizes to numbers of the scene.

    Args:
        numbers: Names that the scene's ``with_added(name, size)`` knows, equally many per
            component, which share its size.
    """
    return partial(_added, numbers=numbers)


def _added(scene: Any, size: Tensor, run: Run, *, numbers: tuple[str, ...]) -> Any:
    """Each number larger by the size (...,) of its component."""
    each = len(numbers) // size.shape[-1]
    for i, name in enumerate(numbers):
        scene = scene.with_added(name, size[..., i // each])
    return scene
