"""Does a covering array hold every pair, and save what it is there to save?"""

from itertools import combinations, product

import pytest

from tests.covering import covering, pairwise

SHAPES = [(2, 2), (3, 3, 3), (5, 2, 2), (4, 3, 3, 2), (2, 2, 2, 2, 2, 2), (1, 4, 1)]


@pytest.mark.parametrize("shape", SHAPES)
def test_every_pair_is_covered(shape):
    values = {f"p{i}": [f"{i}{k}" for k in range(n)] for i, n in enumerate(shape)}
    rows = pairwise(**values)
    assert len(rows) == len(set(rows))
    for (i, some), (j, other) in combinations(enumerate(values.values()), 2):
        assert {(row[i], row[j]) for row in rows} == {*product(some, other)}


@pytest.mark.parametrize("shape, most", [((5, 2, 2), 10), ((4, 3, 3, 2), 13), ((2,) * 6, 8)])
def test_few_rows_do(shape, most):
    assert len(pairwise(**{f"p{i}": range(n) for i, n in enumerate(shape)})) <= most


def test_one_name_gets_all_its_values():
    assert pairwise(kind=["hex", "tet"]) == [("hex",), ("tet",)]


def test_values_that_cannot_be_hashed_or_compared():
    rows = pairwise(a=[{}, {"x": 1}], b=[[], [1]])
    assert len(rows) == 4
    assert ({"x": 1}, []) in rows


@covering(kind=["hex", "tet"], order=[1, 2])
def test_the_mark_passes_values_by_name(kind, order):
    assert (kind, order) in {*product(("hex", "tet"), (1, 2))}


@covering(kind=["hex", "tet"])
def test_the_mark_takes_one_name(kind):
    assert kind in ("hex", "tet")
