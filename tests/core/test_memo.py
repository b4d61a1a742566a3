"""Values by key: computed once, the last ones kept, no copy shares them, large ones in files."""

import copy
import gc
import pickle
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from diffsim.core import memo
from diffsim.core.memo import LARGE, Aside, Memo, SpilledArray, memo_field, spill
from diffsim.identify.linearization import Linearization
from tests.test_attacks import full_disk


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


Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Slopes:
    name: str
    columns: Aside = Aside()


def large(order="C", rows=700):
    values = np.random.default_rng(0).normal(size=(rows, LARGE // 8 // 700 + 1))
    return np.asarray(values, order=order)


@pytest.fixture
def forgotten(monkeypatch):
    """Nothing waits, nothing is at hand: every look reads the file."""
    monkeypatch.setattr(memo, "WAITING", 0)
    monkeypatch.setattr(memo, "_at_hand", memo.Memo(0))


@pytest.mark.parametrize("order", ["C", "F"])
def test_the_same_bits_and_layout_come_back(forgotten, order):
    array = large(order)
    found = SpilledArray(array).array()
    assert found is not array and np.array_equal(found, array)
    assert found.flags.f_contiguous == array.flags.f_contiguous


def test_rows_are_read_without_the_others(forgotten):
    array = large()
    place = SpilledArray(array)
    assert len(place) == len(array) and place.shape == array.shape
    assert np.array_equal(place[13:20], array[13:20]) and np.array_equal(
        place[690:900], array[690:]
    )


def test_fields_of_records_are_laid_aside(forgotten):
    array = large()
    slopes = Slopes("a", array)
    assert not any(value is array for value in vars(slopes).values())
    for other in (slopes, replace(slopes, name="b"), copy.copy(slopes),
                  pickle.loads(pickle.dumps(slopes))):  # fmt: skip
        assert np.array_equal(other.columns, array)
    assert Slopes("none", None).columns is None
    with pytest.raises(TypeError, match="columns"):
        Slopes("missing")


def test_what_nobody_holds_leaves_no_file(forgotten):
    place = SpilledArray(large())
    path = Path(place._path)
    assert path.exists()
    del place
    gc.collect()
    assert not path.exists()


def test_the_newest_wait_in_memory_and_the_oldest_go_to_files(monkeypatch):
    monkeypatch.setattr(memo, "WAITING", 2 * large().nbytes)
    arrays = [large() + k for k in range(4)]
    places = [SpilledArray(array) for array in arrays]
    assert [place.array() is array for place, array in zip(places, arrays, strict=True)] == [
        False,
        False,
        True,
        True,
    ]
    assert all(np.array_equal(p.array(), a) for p, a in zip(places, arrays, strict=True))
    del places[3]
    gc.collect()
    SpilledArray(large())
    assert places[2].array() is arrays[2]  # what is gone takes no room


def test_what_was_asked_for_last_is_at_hand(monkeypatch):
    monkeypatch.setattr(memo, "WAITING", 0)
    places = [SpilledArray(large()) for _ in range(memo.AT_HAND + 1)]
    first = places[0].array()
    assert first is places[0].array()
    for place in places[1:]:
        place.array()
    assert first is not places[0].array()


def test_small_ones_and_those_of_a_full_disk_stay_in_memory(forgotten):
    small, array = np.arange(9.0), large()
    assert spill(small) is small and Slopes("few", small).columns is small
    with full_disk(4_096):
        place = SpilledArray(array)
    assert place.array() is array and np.array_equal(place[3:5], array[3:5])


def test_slopes_of_many_places_take_no_memory(forgotten):
    """A diagnosis keeps those of every set that it tried: 7.5 GB of a positioning system."""
    width = 80

    def place():
        columns = np.ones((LARGE // 8 // width + 1, width))
        return Linearization(np.zeros(width), columns[:, 0].copy(), tuple(range(width)), columns)

    def resident():
        gc.collect()
        memo._give_back()
        status = Path("/proc/self/status").read_text()
        return int(re.search(r"VmRSS:\s+(\d+)", status)[1]) * 1024

    if not Path("/proc/self/status").exists():
        pytest.skip("memory is read as Linux tells it")
    before = resident()
    kept = [place() for _ in range(80)]
    assert resident() - before < 18 * LARGE < 80 * LARGE // 2
    assert all(at.columns.shape[1] == width for at in kept)
