"""A simulator as the diagnosis sees it: parameters and effects in, predicted channels out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from threading import Lock
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor

from diffsim.identify.effect import Effect
from diffsim.identify.numerical import NumericalEffect
from diffsim.identify.numerics import Numerics
from diffsim.identify.parameter import Parameter

if TYPE_CHECKING:
    from diffsim.data.study import Run
    from diffsim.identify.line import Line, Point


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

    Attributes:
        prepared_q: Where ``prepared_at`` made this model, None where nothing is prepared.
    """

    prepared_q: Tensor | None = None

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
        physical, numerical = _parted(sizes)
        self.simulations.add(len(q) if q.ndim > 1 else 1)
        out = plain = self.scene(run, q, physical, numerics).simulate()
        for effect, size in numerical.items():
            if size.requires_grad or bool((size != 0.0).any()):
                finer = (numerics or Numerics()).refined(effect.refined)
                refined = self.predict(run, q, physical, finer)
                out = out + size[..., None] * (refined - plain)
        return out

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
        physical, numerical = _parted(sizes)
        self.simulations.add(len(q))
        out = plain = self.simulate_many(run, q, physical, numerics)
        for effect, size in numerical.items():
            if (rows := torch.nonzero(size[:, 0])[:, 0]).numel():
                finer = (numerics or Numerics()).refined(effect.refined)
                there = {e: s[rows] for e, s in physical.items()}
                change = self.predict_many(run, q[rows], there, finer) - plain[rows]
                out = out.index_add(0, rows, size[rows, :, None] * change)
        return out

    def scene(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor] | None = None,
        numerics: Numerics | None = None,
    ) -> Scene:
        """The run at one point, ready to be simulated; arguments as for ``predict``. Numerical
        effects act on predictions, in no scene."""
        values = {p.name: p.value_at(q[..., i]) for i, p in enumerate(self.base)}
        scene = self.build(values, run, Numerics() if numerics is None else numerics)
        for effect, size in _parted(sizes)[0].items():
            scene = effect.apply(scene, size, run)
        return scene

    def simulate_many(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor],
        numerics: Numerics | None = None,
    ) -> Tensor:
        """As ``predict_many`` without numerical effects; models that have a faster way override
        this."""
        scenes = [
            self.scene(run, q[k], {e: s[k] for e, s in sizes.items()}, numerics)
            for k in range(len(q))
        ]
        return torch.stack(self.simulate_scenes(scenes))

    def simulate_scenes(self, scenes: Sequence[Any]) -> list[Tensor]:
        """Predictions of several scenes of one run; models that have a faster way override this."""
        return [scene.simulate() for scene in scenes]

    def tangents(
        self,
        run: Run,
        at: Point,
        lines: Sequence[Line],
        numerics: Numerics | None = None,
    ) -> tuple[Tensor, Tensor] | None:
        """The prediction of a run and its derivatives, for models quicker than their simulations.

        Args:
            run: The run.
            at: Where.
            lines: K smooth coordinates.
            numerics: As for ``predict``.

        Returns:
            (num_samples, num_channels) and (K, num_samples, num_channels); None: difference
            simulations instead.
        """
        return None

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


def _parted(
    sizes: Mapping[Effect, Tensor] | None,
) -> tuple[dict[Effect, Tensor], dict[NumericalEffect, Tensor]]:
    """What acts in the scene, and what on its prediction."""
    given = sizes or {}
    numerical = {e: s for e, s in given.items() if isinstance(e, NumericalEffect)}
    return {e: s for e, s in given.items() if e not in numerical}, numerical


def has_tangents(model: SimModel) -> bool:
    """Whether a model differentiates its predictions itself (a method ``tangents`` of its own)."""
    return getattr(type(model), "tangents", None) is not getattr(SimModel, "tangents", None)
