"""A candidate cause: a differentiable term with an amplitude that is zero in the plain model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar

from torch import Tensor

if TYPE_CHECKING:
    from diffsim.data.study import Run, Study

KINDS = ("force", "actuator", "sensor", "material", "environment", "numerical")


class Effect(ABC):
    """One cause, named by its form; physical causes that share the form are its aliases.

    Class attributes:
        name: Such as "linear_drag".
        family: Effects of one family are alternatives of each other, such as "damping".
        kind: One of ``KINDS``.
        unit: Of every component.
        typical: A size that would be no surprise, in ``unit``; the prior of a component is
            N(0, (1.5 typical)^2), half-normal unless ``signed``.
        signed: Whether components may be negative.
        components: Names of the amplitudes, one or more (a vector enters as one block).
        smooth: False where the response has a kink at zero: then a secant at a tenth of the typical
            size stands for the derivative.
        also_looks_like: Physical causes and other forms that these data may not tell from it.
    """

    name: ClassVar[str]
    family: ClassVar[str]
    kind: ClassVar[str]
    unit: ClassVar[str]
    typical: ClassVar[float]
    signed: ClassVar[bool] = True
    components: ClassVar[tuple[str, ...]] = ("size",)
    smooth: ClassVar[bool] = True
    also_looks_like: ClassVar[tuple[str, ...]] = ()

    def needs(self, study: Study) -> str | None:
        """What the study lacks for this effect to be judged at all; None if nothing."""
        return None

    @abstractmethod
    def apply(self, scene: Any, size: Tensor, run: Run) -> Any:
        """The scene with the effect at this size; at zero it must be the scene itself.

        Args:
            scene: What the model's ``build`` made for this run.
            size: (num_components,) [unit].
            run: The run that is simulated.
        """
