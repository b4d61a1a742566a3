"""Constants of a saved model in the words of other programs, by the formulas of a study."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch

from diffsim.core.check import did_you_mean
from diffsim.core.expression import Expression, parse_expression
from diffsim.data.study import Study
from diffsim.identify.effect import effect_coordinates
from diffsim.identify.model_file import SavedModel
from diffsim.systems.description import quantities_of
from diffsim.systems.registry import description_of, setup_of

STEP = 0.01  # of the sd: difference quotients of formulas that may have kinks


class Constant(NamedTuple):
    """A number for another program.

    Attributes:
        value: What the formula gives with the saved values.
        sd: Its standard deviation by those of the values, taken as independent.
    """

    value: float
    sd: float


def constants_of(study: Study, saved: SavedModel) -> dict[str, dict[str, Constant]]:
    """Values of the study's `export` formulas, by program and name.

    Numbers that are known have their stated value, causes that the model has not have size 0.

    Args:
        study: The study with its `export`.
        saved: Its answer.

    Raises:
        ValueError: no `export`, or a formula with a name that there is not.
    """
    if not study.export:
        raise ValueError(
            f"{study.name}: no `export` in the study; name constants and their formulas, such as "
            "export: {mujoco: {damping: kt**2/resistance}}"
        )
    known = _known_values(study) | dict(saved.values)
    return {
        program: {
            name: _constant(f"export.{program}.{name}", formula, known, saved.sd)
            for name, formula in formulas.items()
        }
        for program, formulas in study.export.items()
    }


def _known_values(study: Study) -> dict[str, float]:
    """Stated values of all quantities, and 0 for each cause."""
    described = description_of(study)
    stated = {**quantities_of(described), **getattr(described, "parameters", {})}
    sizes = dict.fromkeys(effect_coordinates(setup_of(study).effects), 0.0)
    return sizes | {name: float(quantity.value) for name, quantity in stated.items()}


def _constant(
    where: str, formula: str, known: Mapping[str, float], sd: Mapping[str, float]
) -> Constant:
    parsed = parse_expression(formula)
    for name in parsed.names:
        if name not in known:
            raise ValueError(f"{where}: no number {name!r}{did_you_mean(name, list(known))}")
    value = _evaluate(parsed, known)
    slopes = [_slope(parsed, known, name, sd[name]) for name in parsed.names if name in sd]
    return Constant(value, math.hypot(*slopes))


def _slope(parsed: Expression, known: Mapping[str, float], name: str, sd: float) -> float:
    """Change of the formula with one sd of a name."""
    above, below = (_evaluate(parsed, {**known, name: known[name] + s * sd}) for s in (STEP, -STEP))
    return (above - below) / (2.0 * STEP)


def _evaluate(parsed: Expression, known: Mapping[str, float]) -> float:
    values = {name: torch.tensor(known[name], dtype=torch.float64) for name in parsed.names}
    return float(parsed(values))
