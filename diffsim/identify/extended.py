"""A model with effects built in: their sizes are ordinary, differentiable parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffsim.core.checked import checked, checked_methods
from diffsim.identify.effect import Effect, effect_coordinates
from diffsim.identify.fitting import Fit
from diffsim.identify.model import Parameter, Scene, SimModel
from diffsim.identify.numerics import Numerics

if TYPE_CHECKING:
    from diffsim.data.study import Run


@checked_methods
class ExtendedModel(SimModel):
    """A model whose base parameters are those of another one, then the sizes of effects.

    Args:
        inner: The plain model, whose base parameters come first.
        effects: Effects to build in, in this order.
        base: Parameters of ``inner``, then the components of the effects ("wind.x").
        numerics: Refined numerical settings that it was fitted with; None: the plain model's own.
    """

    def __init__(
        self,
        inner: SimModel,
        effects: Sequence[Effect],
        base: Sequence[Parameter],
        numerics: Numerics | None = None,
    ):
        suffix = "".join(f" + {e.name}" for e in effects)
        super().__init__(self._build, base, inner.name + suffix, batched=inner.batched)
        self.inner, self.effects, self.refined = inner, tuple(effects), numerics
        self.simulations, self.frame, self.cuts = inner.simulations, inner.frame, inner.cuts
        self._components = [effect_coordinates([e]) for e in effects]

    def cost(self, run: Run, numerics: Numerics | None = None) -> float:
        """Weighted steps of one prediction: those of the plain model."""
        return self.inner.cost(run, self._settings(numerics))

    def _build(self, values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> Scene:
        values_of_inner = {p.name: values[p.name] for p in self.inner.base}
        scene = self.inner.build(values_of_inner, run, self._settings(numerics) or Numerics())
        for effect, components in zip(self.effects, self._components, strict=True):
            size = torch.stack([values[c] for c in components], dim=-1)
            scene = effect.act(scene, size, run, values)
        return scene

    def predict(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor] | None = None,
        numerics: Numerics | None = None,
    ) -> Tensor:
        """Prediction of the plain model with its effects, (num_samples, num_channels)."""
        own = self._settings(numerics)
        return self.inner.predict(run, self._inner_q(q), self._sizes(q, sizes), own)

    def predict_many(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor] | None = None,
        numerics: Numerics | None = None,
    ) -> Tensor:
        """Predictions at many points, as many at once as the plain model can."""
        own = self._settings(numerics)
        return self.inner.predict_many(run, self._inner_q(q), self._sizes(q, sizes), own)

    def _settings(self, numerics: Numerics | None) -> Numerics | None:
        """Factors on the plain model's settings: its refined ones, and what is asked for beyond."""
        if self.refined is None:
            return numerics
        return self.refined if numerics is None else self.refined.refined(numerics)

    def _inner_q(self, q: Tensor) -> Tensor:
        """Standardized coordinates of the plain model, (..., num_base): the same values."""
        columns = []
        for i, (own, plain) in enumerate(zip(self.base, self.inner.base, strict=False)):
            offset = plain.coordinate_of(own.value)
            width = own.sd / plain.sd  # both of the value, or both of its logarithm
            columns.append(offset + width * q[..., i])
        return torch.stack(columns, dim=-1) if columns else q[..., :0]

    def _sizes(self, q: Tensor, more: Mapping[Effect, Tensor] | None) -> dict[Effect, Tensor]:
        sizes, k = {}, len(self.inner.base)
        for effect in self.effects:
            own = range(k, k := k + len(effect.components))
            sizes[effect] = torch.stack([self.base[i].value_at(q[..., i]) for i in own], dim=-1)
        return sizes | dict(more or {})

    def num_fitted_inside(self, run: Run) -> int:
        """Values that the plain model fits to a run inside, such as its start state."""
        inside = getattr(self.inner, "num_fitted_inside", None)
        return int(inside(run)) if callable(inside) else 0

    def short_windows(self, runs: Sequence[Run]) -> Mapping[str, float]:
        """Windows of the plain model that had to be short, by run [s]."""
        return self.inner.short_windows(runs)

    def prepared_at(self, q: Tensor, runs: Sequence[Run] = ()) -> SimModel:
        """The model with the plain model prepared at the values of its own parameters at ``q``."""
        inner = self.inner.prepared_at(self._inner_q(q), runs)
        return ExtendedModel(inner, self.effects, self.base, self.refined)


@checked
def extended_model(fit: Fit) -> ExtendedModel:
    """The fitted model and its effects as one model.

    Args:
        fit: Fit with effects; its posterior becomes the prior of the new model's parameters.

    Returns:
        A model whose base parameters are the old ones, then the sizes ("wind.x").
    """
    problem = fit.problem
    return extended_at(
        problem.model, problem.effects, fit.values, fit.sd, problem.reference_numerics
    )


def extended_at(
    inner: SimModel,
    effects: Sequence[Effect],
    values: Mapping[str, float],
    sd: Mapping[str, float],
    numerics: Numerics | None = None,
) -> ExtendedModel:
    """A model with effects built in, at given values.

    Args:
        values, sd: Center and width of the new priors by name of base parameter or component, each
            in its unit.
        numerics: Refined numerical settings; None: the plain model's own.
    """
    base = [
        Parameter(
            p.name,
            values[p.name],
            sd[p.name] / (values[p.name] if p.log else 1.0),
            p.unit,
            p.log,
            p.lower,
            p.upper,
        )
        for p in inner.base
    ]
    sizes = [
        Parameter(
            name,
            values[name],
            sd[name],
            effect.unit,
            lower=-np.inf if effect.signed else 0.0,
        )
        for effect in effects
        for name in effect_coordinates([effect])
    ]
    return ExtendedModel(inner, effects, [*base, *sizes], numerics)
