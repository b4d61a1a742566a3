"""Effects that make numbers of a scene larger."""

from __future__ import annotations

from typing import Any, ClassVar

from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect


class AddingEffect(Effect):
    """Adds its sizes to numbers of the scene, which has ``with_added(name, size)``.

    Class attributes:
        adds_to: Names of the numbers, equally many per component, which share its size.
    """

    adds_to: ClassVar[tuple[str, ...]]

    def apply(self, scene: Any, size: Tensor, run: Run) -> Any:
        """Each number larger by the size (...,) of its component."""
        each = len(self.adds_to) // len(self.components)
        for i, name in enumerate(self.adds_to):
            scene = scene.with_added(name, size[..., i // each])
        return scene
