"""A model with effects built in: their sizes are ordinary, differentiable parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffsim.diagnose.model import Numerics, Scene, SimModel
from diffsim.identify import Fit, Parameter
from diffsim.identify.problem import effect_coordinates

if TYPE_CHECKING:
    from diffsim.data.study import Run


def extended_model(fit: Fit) -> SimModel:
    """The fitted model and its effects as one model.

    Args:
        fit: With effects; its posterior becomes the prior of the new model's parameters.

    Returns:
        A model whose base parameters are the old ones, then the sizes ("wind.x").
    """
    problem, inner = fit.problem, fit.problem.model
    names = [effect_coordinates([e]) for e in problem.effects]

    def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> Scene:
        scene = inner.build({p.name: values[p.name] for p in inner.base}, run, numerics)
        for effect, components in zip(problem.effects, names, strict=True):
            scene = effect.apply(scene, torch.stack([values[c] for c in components]), run)
        return scene

    base = [
        Parameter(
            p.name,
            fit.values[p.name],
            fit.sd[p.name] / (fit.values[p.name] if p.log else 1.0),
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
            fit.values[name],
            fit.sd[name],
            effect.unit,
            lower=-np.inf if effect.signed else 0.0,
        )
        for effect, components in zip(problem.effects, names, strict=True)
        for name in components
    ]
    suffix = "".join(f" + {e.name}" for e in problem.effects)
    return SimModel(build, [*base, *sizes], name=inner.name + suffix)
