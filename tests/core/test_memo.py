"""Values by key: computed once, the last ones kept, no copy shares them."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace

import pytest

from diffsim.core.memo import Memo, memo_field


class Counted:
    """Squares, and the numbers that were asked for."""

    def __init__(self, most):
        self.memo, self.computed = Memo(most), []

    def __call__(self, x):
        return self.memo(x, lambda: (self.computed.append(x), x * x)[1])


def test_the_values_asked_for_last_are_kept():
    square = Counted(2)
    assert [square(x) for x in (1, 2, 1, 3, 1, 2)] == [1, 4, 1, 9, 1, 4]
    assert square.computed == [1, 2, 3, 2]  # 2 went when 3 came: 1 had been asked for since


def test_what_fails_is_asked_for_again():
    square = Counted(2)

    def fail():
        raise ValueError("not now")

    with pytest.raises(ValueError, match="not now"):
        square.memo(3, fail)
    assert square(3) == 9


def test_a_value_may_ask_for_others():
    memo = Memo(8)

    def factorial(n):
        return memo(n, lambda: n * factorial(n - 1) if n else 1)

    assert factorial(5) == 120


def test_copies_begin_empty():
    square = Counted(2)
    square(3)
    other = pickle.loads(pickle.dumps(square.memo))
    assert other(3, lambda: -1) == -1
    assert square(3) == 9

    @dataclass(frozen=True)
    class Record:
        x: int
        memo: Memo[int] = memo_field(2)

    one = Record(1)
    assert one.memo("x", lambda: one.x) == 1
    two = replace(one, x=2)
    assert two.memo("x", lambda: two.x) == 2
    assert two == Record(2)
