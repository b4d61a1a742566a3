"""A simulator as the diagnosis sees it: parameters and effects in, predicted channels out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor

from diffsim.diagnose.effect import Effect
from diffsim.identify.parameter import Parameter

if TYPE_CHECKING:
    from diffsim.data.study import Run


@dataclass(frozen=True)
class Numerics:
    """Numerical settings relative to those that the model uses by default.

    Attributes:
        time_step: Factor on the time step.
        mesh: Factor on the cell size.
        tolerance: Factor on solver tolerances.
    """

    time_step: float = 1.0
    mesh: float = 1.0
    tolerance: float = 1.0


class Scene(Protocol):
    """One run, ready to be simulated; beds add the hooks that their effects use."""

    def simulate(self) -> Tensor:
        """Predicted channels at the run's sample times, (num_samples, num_channels)."""
        ...


class Tally:
    """How many simulations were asked for; threads may count at once."""

    def __init__(self) -> None:
        self.count, self._lock = 0, Lock()

    def add(self, number: int) -> None:
        """Count more."""
        with self._lock:
            self.count += number


Build = Callable[[Mapping[str, Tensor], "Run", Numerics], Scene]


class SimModel:
    """A simulator with base parameters.

    Args:
        build: Makes the scene of a run from values of the base parameters by name.
        base: What is imperfectly known: materials, gains, and nuisances of the set-up.
        name: Of the simulator.
        batched: Whether scenes and effects take many points at once: then values may be (K,),
            sizes (K, num_components) and predictions (K, num_samples, num_channels).
    """

    def __init__(
        self,
        build: Build,
        base: Sequence[Parameter],
        name: str = "model",
        *,
        batched: bool = False,
    ):
        names = [p.name for p in base]
        if repeated := {n for n in names if names.count(n) > 1}:
            raise ValueError(f"base parameters repeat: {sorted(repeated)}")
        self.build, self.base, self.name, self.batched = build, tuple(base), name, batched
        self.simulations = Tally()

    def predict(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor] | None = None,
        numerics: Numerics | None = None,
    ) -> Tensor:
        """Predicted channels of a run, (num_samples, num_channels).

        Args:
            run: The run.
            q: Standardised base parameters, (num_base,) float64.
            sizes: Effects with their sizes [unit], (num_components,) each, applied in this order.
            numerics: Settings; the model's own if None.
        """
        self.simulations.add(len(q) if q.ndim > 1 else 1)
        return self.scene(run, q, sizes, numerics).simulate()

    def predict_many(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor] | None = None,
        numerics: Numerics | None = None,
    ) -> Tensor:
        """Predictions at many points, (K, num_samples, num_channels): at once where ``batched``.

        Args:
            run: The run.
            q: (K, num_base).
            sizes: (K, num_components) each.
            numerics: As for ``predict``.
        """
        if self.batched:
            return self.predict(run, q, sizes, numerics)
        self.simulations.add(len(q))
        scenes = [
            self.scene(run, q[k], {e: s[k] for e, s in (sizes or {}).items()}, numerics)
            for k in range(len(q))
        ]
        return torch.stack(self.simulate_scenes(scenes))

    def scene(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor] | None = None,
        numerics: Numerics | None = None,
    ) -> Scene:
        """The run at one point, ready to be simulated; arguments as for ``predict``."""
        values = {p.name: p.value_at(q[..., i]) for i, p in enumerate(self.base)}
        scene = self.build(values, run, Numerics() if numerics is None else numerics)
        for effect, size in (sizes or {}).items():
            scene = effect.apply(scene, size, run)
        return scene

    def simulate_scenes(self, scenes: Sequence[Any]) -> list[Tensor]:
        """Predictions of several scenes of one run; models that have a faster way override this."""
        return [scene.simulate() for scene in scenes]

    def prepared_at(self, q: Tensor) -> SimModel:
        """The model with whatever it prepares once prepared again at these base coordinates.

        Args:
            q: (num_base,) standardised.

        Returns:
            The model itself where nothing is prepared.
        """
        return self

    def at_prior(self) -> Tensor:
        """Standardised coordinates of the best guess, (num_base,)."""
        return torch.zeros(len(self.base), dtype=torch.float64)
