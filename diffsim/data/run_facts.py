"""Facts of runs: numbers and labels, stated in the study or taken from the run's file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import ValidationError

from diffsim.core.schema import problem_lines
from diffsim.core.units import to_si
from diffsim.data.columns import as_label
from diffsim.data.run_plan import filled
from diffsim.data.run_samples import Samples
from diffsim.data.study_schema import Fact


def facts_of(
    setup: Mapping[str, Any], samples: Samples, words: Mapping[str, str], where: str
) -> dict[str, Any]:
    """Facts of a run, in SI units.

    Args:
        setup: As the study states them.
        samples: Rows of the run.
        words: What {name} stands for in texts.
        where: What messages call it, such as "runs[2].setup".

    Raises:
        ValueError: a fact that cannot be read, or a column that is not constant.
    """
    return {name: _fact(f"{where}.{name}", name, v, samples, words) for name, v in setup.items()}


def _fact(where: str, name: str, stated: Any, samples: Samples, words: Mapping[str, str]) -> Any:
    if stated == "column":
        stated = {}
    if isinstance(stated, bool) or stated is None:
        raise ValueError(f"{where} must be a number, a label or a mapping, got {stated!r}")
    if isinstance(stated, (int, float)):
        return float(stated)
    if isinstance(stated, str):
        return _as_fact(filled(stated, words, where))
    try:
        fact = Fact.model_validate(stated)
    except ValidationError as error:
        raise ValueError("\n".join(problem_lines(where, error))) from None
    si = to_si(fact.unit)
    if fact.value is not None:
        value = fact.value if isinstance(fact.value, float) else filled(fact.value, words, where)
        value = _as_fact(value) if isinstance(value, str) else value
        if isinstance(value, str) and fact.unit != "-":
            raise ValueError(f"{where} must be a number in {fact.unit}, got {value!r}")
        return value if isinstance(value, str) else si.factor * value + si.offset
    if fact.formula is not None:
        values = samples.formula(fact.formula)
    else:
        column = fact.column or name
        samples.table.require(column)
        if not samples.table.is_number[column]:
            return _label(where, column, samples)
        values = samples.column(column)
    return si.factor * _taken(where, values, fact.take) + si.offset


def _as_fact(text: str) -> float | str:
    label = as_label(text)
    return label if isinstance(label, str) else float(label)


def _label(where: str, column: str, samples: Samples) -> str:
    cells = samples.table.texts(column)
    found = list(dict.fromkeys(cells[i] for i in samples.rows))
    if len(found) > 1:
        raise ValueError(
            f"{where}: column {column} of {samples.table.path.name} is not constant in the run: "
            f"{', '.join(found[:5])}"
        )
    return found[0]


def _taken(where: str, values: np.ndarray, take: str) -> float:
    there = values[np.isfinite(values)]
    if not len(there):
        raise ValueError(f"{where}: all cells are empty")
    if take == "first":
        return float(there[0])
    if take == "last":
        return float(there[-1])
    if take == "constant" and np.ptp(there) > 1e-9 * max(abs(float(there[0])), 1e-300):
        raise ValueError(
            f"{where}: the column is not constant in the run, it goes from {there.min():g} to "
            f"{there.max():g}; say take: first, last or mean"
        )
    return float(there[0]) if take == "constant" else float(np.mean(there))
