"""Base parameters apart: those that all runs share, and those by which groups and runs scatter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffsim.core.arrays import Array, IntArray, Mask
from diffsim.core.check import did_you_mean
from diffsim.core.memo import Memo, memo_field
from diffsim.data.fault_keys import FaultKeys
from diffsim.data.study import Run
from diffsim.identify.effect import touches
from diffsim.identify.model import Parameter

COMMON = -1


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the base parameters belong."""

    names: tuple[str, ...]
    family: IntArray  # family of each that scatters, ``COMMON`` for the others, (num_base,)
    is_daily: Mask  # whether it is one of a group, (num_base,)
    is_state: Mask  # whether it is one of a state that several groups share, (num_base,)
    families: tuple[str, ...]  # names of the families, such as "gain_1, gain_2"
    # spread that the study states for each family, in the unit of its parameters
    stated: tuple[float, ...]
    _acting: Memo[tuple[list[int], list[int]]] = memo_field()

    @property
    def shared(self) -> list[int]:
        """Indices of the parameters that several groups share, states included."""
        return np.flatnonzero((self.family == COMMON) | self.is_state).tolist()

    def of(self, runs: Sequence[Run]) -> tuple[list[int], list[int]]:
        """Indices of the parameters that act in runs: shared ones, then those of the runs alone."""
        key = tuple((run.name, tuple(run.setup.items())) for run in runs)
        common, scatter = self._acting(key, lambda: self._split_acting(runs))
        return list(common), list(scatter)

    def _split_acting(self, runs: Sequence[Run]) -> tuple[list[int], list[int]]:
        acting = [i for i, n in enumerate(self.names) if any(touches(n, run) for run in runs)]
        shared = set(self.shared)
        return [i for i in acting if i in shared], [i for i in acting if i not in shared]

    def shared_precision(self, log_spread: Array) -> Array:
        """Prior precision of the shared parameters, (num_shared,).

        Args:
            log_spread: Logarithms of spreads over stated ones, (num_families,).
        """
        family = self.family[self.shared]
        spread = np.append(np.exp(log_spread), 1.0)  # the last one for those without a family
        return np.asarray(spread[family] ** -2)


def layout_of(base: Sequence[Parameter], keys: FaultKeys) -> Layout:
    """Base parameters of a model as ``faults.scatter`` divides them.

    Raises:
        ValueError: a quantity that is not fitted, or not stated per run or group; families whose
            first guesses differ.
    """
    quantity = [_quantity(p.name) for p in base]
    family = np.full(len(base), COMMON)
    is_daily = np.zeros(len(base), dtype=bool)
    is_state = np.zeros(len(base), dtype=bool)
    stated = []
    for k, members in enumerate(keys.scatter):
        widths = set()
        for name in members:
            own = [i for i, (q, _) in enumerate(quantity) if q == name]
            if not own:
                hint = did_you_mean(name, {q for q, _ in quantity})
                raise ValueError(f"faults.scatter[{k}]: no fitted quantity {name!r}{hint}")
            per = quantity[own[0]][1]
            if per not in ("run", keys.per, keys.state):
                raise ValueError(f"faults.scatter[{k}]: state {name} `per: {keys.per}` or per run")
            family[own] = k
            is_daily[own] = per == keys.per
            is_state[own] = per == keys.state
            widths |= {base[i].sd for i in own}
        if len(widths) > 1:
            raise ValueError(f"faults.scatter[{k}]: {', '.join(members)} need the same sd")
        stated.append(widths.pop())
    names = tuple(", ".join(members) for members in keys.scatter)
    return Layout(tuple(p.name for p in base), family, is_daily, is_state, names, tuple(stated))


def _quantity(parameter: str) -> tuple[str, str]:
    """Quantity of a base parameter, and what it is stated per."""
    if "@" in parameter:
        return parameter.partition("@")[0], "run"
    if parameter.endswith("]"):
        name, _, fact = parameter[:-1].partition("[")
        return name, fact.partition("=")[0]
    return parameter, ""
