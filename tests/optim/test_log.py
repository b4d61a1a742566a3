"""The log: searches interrupted anywhere end with the bits of one that was not."""

import json
from functools import lru_cache

import numpy as np
import pytest
from scipy import optimize

from diffsim.core.errors import DiffsimError
from diffsim.optim import Budget, Log, Options, Sample, minimize, multi_start, screen

START = np.array([-1.2, 1.0, 1.0 / 3.0])
BOUNDS = (np.full(3, -2.0), np.array([2.0, 0.5, 2.0]))
OPTIONS = Options(Budget(14))


class Objective:
    """Rosenbrock's function with a cliff; interrupted, as by Ctrl-C, after some calls."""

    def __init__(self, calls=10**6):
        self.calls, self.left = 0, calls

    def __call__(self, x):
        if self.left == 0:
            raise KeyboardInterrupt
        self.left -= 1
        self.calls += 1
        if x[0] > -0.6:
            raise DiffsimError("beyond the cliff")
        return Sample(optimize.rosen(x), optimize.rosen_der(x), {"third": x[2]})


def assert_same(a, b):
    """All results, to the last bit; times differ."""
    assert (a.ended, a.message, a.num_evaluations) == (b.ended, b.message, b.num_evaluations)
    for one, two in zip((*a.history, a.final), (*b.history, b.final), strict=True):
        assert one.x.tobytes() == two.x.tobytes()
        assert (one.value, one.failure, one.notes) == (two.value, two.failure, two.notes)
        if one.gradient is not None:
            assert one.gradient.tobytes() == two.gradient.tobytes()


@lru_cache
def whole():
    """The search that nothing interrupts."""
    return minimize(Objective(), START, BOUNDS, OPTIONS)


def test_the_search_meets_the_wall_on_its_way():
    assert 0 < whole().num_failed < whole().num_evaluations == 14


@pytest.mark.parametrize("calls", range(15))
def test_interrupted_anywhere_it_goes_on_with_the_same_bits(tmp_path, calls):
    path = tmp_path / "deep" / "run.jsonl"
    if calls < 14:
        with pytest.raises(KeyboardInterrupt):
            minimize(Objective(calls), START, BOUNDS, OPTIONS, log=Log(path))
    else:
        minimize(Objective(), START, BOUNDS, OPTIONS, log=Log(path))
    rest, replayed = Objective(), []
    again = minimize(
        rest,
        START,
        BOUNDS,
        OPTIONS,
        log=Log(path),
        callback=lambda p: replayed.append(p.replayed),
    )
    assert_same(again, whole())
    assert rest.calls == 14 - calls
    assert replayed == [True] * calls + [False] * (14 - calls)
    assert len(path.read_text().splitlines()) == 1 + 14


def test_torn_in_its_last_line_only_that_is_lost(tmp_path):
    path = tmp_path / "run.jsonl"
    minimize(Objective(), START, BOUNDS, Options(Budget(3)), log=Log(path))
    content = path.read_bytes()
    last = content[:-1].rfind(b"\n") + 1
    for cut in (last, *range(last + 1, len(content) - 1, 23), len(content) - 1):
        path.write_bytes(content[:cut])
        objective = Objective()
        minimize(objective, START, BOUNDS, Options(Budget(3)), log=Log(path))
        assert objective.calls == 1
        assert len(Log(path)["evaluations"]) == 3


def test_torn_in_its_first_line_it_begins_anew(tmp_path):
    path = tmp_path / "run.jsonl"
    Log(path, {"mesh": "coarse"}).append("a", {"b": 1})
    header = path.read_bytes().split(b"\n")[0]
    for cut in (0, 1, 20, len(header)):
        path.write_bytes(header[:cut])
        log = Log(path, {"mesh": "coarse"})
        log.append("a", {"b": 2})
        assert Log(path, {"mesh": "coarse"})["a"] == ({"b": 2},)


def test_longer_budget_goes_on_from_a_shorter_one(tmp_path):
    path = tmp_path / "run.jsonl"
    minimize(Objective(), START, BOUNDS, Options(Budget(5)), log=Log(path))
    rest = Objective()
    assert_same(minimize(rest, START, BOUNDS, OPTIONS, log=Log(path)), whole())
    assert rest.calls == 9


def test_lists_of_a_log_do_not_mix(tmp_path):
    log, other = Log(tmp_path / "run.jsonl"), START + 0.1
    minimize(Objective(), START, BOUNDS, OPTIONS, log=log, name="one")
    second = minimize(Objective(), other, BOUNDS, OPTIONS, log=log, name="two")
    assert_same(second, minimize(Objective(), other, BOUNDS, OPTIONS))
    rest = Objective(0)
    assert_same(minimize(rest, START, BOUNDS, OPTIONS, log=Log(log.path), name="one"), whole())


@pytest.mark.parametrize("calls", [0, 3, 8, 9, 20])
def test_interrupted_multi_start_goes_on(tmp_path, calls):
    def run(objective, log=None):
        return multi_start(objective, BOUNDS, OPTIONS, count=8, keep=2, seed=5, log=log)

    whole, path = run(Objective()), tmp_path / "run.jsonl"
    total = 8 + sum(d.num_evaluations for d in whole.descents)
    with pytest.raises(KeyboardInterrupt):
        run(Objective(calls), Log(path))
    rest = Objective()
    again = run(rest, Log(path))
    assert rest.calls == total - calls
    for a, b in zip(again.descents, whole.descents, strict=True):
        assert_same(a, b)


def test_failed_start_is_tried_again(tmp_path):
    log = Log(tmp_path / "run.jsonl")
    log.append("evaluations", {"x": START, "value": None, "gradient": None, "failure": "bug"})
    objective = Objective()
    assert_same(minimize(objective, START, BOUNDS, OPTIONS, log=log), whole())


def test_screened_points_are_not_evaluated_again(tmp_path):
    points = [START, START + 0.7, START]
    log = Log(tmp_path / "run.jsonl")
    first = screen(Objective(), points, log=log)
    assert [bool(e.failure) for e in first] == [False, True, False]
    again = screen(Objective(0), points, log=Log(log.path))
    assert [e.value for e in again] == [e.value for e in first]


def test_other_settings_are_refused(tmp_path):
    path = tmp_path / "run.jsonl"
    Log(path, {"cells": (3, 2), "size": np.float64(0.1)}).append("a", {})
    assert len(Log(path, {"cells": [3, 2], "size": 0.1})["a"]) == 1
    with pytest.raises(ValueError, match=r"belongs to another run, one of .*3, 2.*delete it"):
        Log(path, {"cells": [4, 2], "size": 0.1})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (json.dumps({"settings": {"device": "gate"}, "samples": []}, indent=2) + "\n", "older"),
        (json.dumps({"values": [1.0], "loss": 2.0, "with_gradient": True}) + "\n", "older"),
        ("my notes", "is no log of evaluations"),
        ("x,y\n1,2\n", "is no log of evaluations"),
        ("[1, 2]\n", "is no log of evaluations"),
        (b"\xff\xfe\n", "is no log of evaluations"),
        (json.dumps({"format": "diffsim.optim.log", "version": 9}) + "\n", "version 9, not 1"),
    ],
)
def test_other_files_are_refused_and_left_as_they_are(tmp_path, content, message):
    path = tmp_path / "file"
    content = content if isinstance(content, bytes) else content.encode()
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        Log(path)
    assert path.read_bytes() == content


def test_damaged_line_is_named(tmp_path):
    path = tmp_path / "run.jsonl"
    minimize(Objective(), START, BOUNDS, Options(Budget(3)), log=Log(path))
    lines = path.read_text().splitlines()
    lines[2] = lines[2][:10]
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(ValueError, match="line 3, is damaged"):
        Log(path)


def test_a_log_without_a_file_is_kept_in_memory():
    log = Log()
    minimize(Objective(), START, BOUNDS, OPTIONS, log=log)
    assert_same(minimize(Objective(0), START, BOUNDS, OPTIONS, log=log), whole())
