"""Start values of runs that begin as their first readings show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from pydantic import Field, model_validator

from diffsim.data.study import Study
from diffsim.identify import Parameter
from diffsim.systems.description import Quantity


class StartQuantity(Quantity):
    """A start value; with ``first`` each run has a best guess of its own, from which a fit needs
    fewer steps."""

    value: float = Field(0.0, description="Best guess beforehand")
    first: str | None = Field(
        None, description="Channel whose first reading is the best guess in each run; `per: run`"
    )

    @model_validator(mode="after")
    def _check_first(self) -> StartQuantity:
        if ("value" in self.model_fields_set) == (self.first is not None):
            raise ValueError("give one of value, first")
        if self.first is not None and (self.per != "run" or self.sd is None):
            raise ValueError("first needs per: run and sd, how far starts may be from the reading")
        return self


BEGIN = 8  # samples of a run that tell where and how fast it begins


def with_first_readings(
    base: Sequence[Parameter], starts: Mapping[str, Quantity], study: Study
) -> tuple[Parameter, ...]:
    """Base parameters whose starts are those of the first readings, within their bounds.

    Args:
        base: Base parameters, a start of each run called "NAME@RUN".
        starts: Quantities by name.
        study: Recorded runs; one whose first samples lack the channel begins as the others in the
            mean.
    """
    names = [channel.name for channel in study.channels]
    found: dict[str, float] = {}
    for key, q in starts.items():
        if not isinstance(q, StartQuantity) or q.first is None:
            continue
        begins = {run.name: run.measured[:BEGIN, names.index(q.first)] for run in study.runs}
        read = {n: float(b[np.isfinite(b)][0]) for n, b in begins.items() if np.isfinite(b).any()}
        usual = float(np.mean(list(read.values()))) if read else q.value
        found |= {f"{key}@{name}": read.get(name, usual) for name in begins}
    return tuple(
        replace(p, value=min(max(found[p.name], p.lower), p.upper)) if p.name in found else p
        for p in base
    )
