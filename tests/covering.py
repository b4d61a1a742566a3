"""Covering arrays: every pair of parameter values at least once, in place of all combinations.

What goes wrong depends on one value or on two together far more often than on three or more; a
matrix of 5 x 2 x 2 cases becomes 10, one of 4 x 3 x 3 x 2 becomes 12.
"""

from itertools import combinations, product
from typing import Any

import pytest


def pairwise(**values: Any) -> list[tuple[Any, ...]]:
    """Few rows of one value per name in which every pair of values of two names occurs.

    The rows depend on the number and the order of names and values alone.
    """
    lists = [list(choices) for choices in values.values()]
    # of one name there is no pair: then every value counts
    pairs = {
        row: {*combinations(enumerate(row), 2)} or {*enumerate(row)}
        for row in product(*(range(len(choices)) for choices in lists))
    }
    missing = set().union(*pairs.values())
    chosen = []
    while missing:
        best = max(pairs, key=lambda row: len(pairs[row] & missing))
        chosen.append(best)
        missing -= pairs[best]
    return [tuple(lists[i][k] for i, k in enumerate(row)) for row in sorted(chosen)]


def covering(**values: Any) -> pytest.MarkDecorator:
    """Mark that runs a test with every pair of values: ``@covering(kind=["hex", "tet"], ...)``."""
    return pytest.mark.parametrize(list(values), pairwise(**values))
