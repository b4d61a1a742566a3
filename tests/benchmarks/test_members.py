"""The table of members: medians over rounds, a column for each instruction set and count."""

import pytest

from benchmarks import members


def test_rows_are_medians_over_rounds(monkeypatch):
    rounds = iter([3.0, 30.0, 1.0, 10.0, 2.0, 50.0])
    monkeypatch.setattr(members, "available", lambda: ["avx512", "avx2", "baseline"])
    monkeypatch.setattr(members, "measured_with", lambda name: {"a step": [next(rounds), 0.25]})
    assert members.table(3).splitlines() == [
        "| us each | AVX2, 1 | AVX2, 288 | AVX-512, 1 | AVX-512, 288 |",
        "|---|---:|---:|---:|---:|",
        "| a step | 2 | 0.25 | 30 | 0.25 |",
    ]


def test_a_members_time_is_that_of_a_step_of_one_of_many(monkeypatch):
    calls = []
    monkeypatch.setattr(members, "microseconds", lambda call: calls.append(call()) or 1e6)
    monkeypatch.setattr(members, "COUNTS", (1, 4))
    found = members.measure()
    assert len(calls) == 2 * len(found)
    alone, of_four = found["`ode`, step"]
    assert alone == pytest.approx(1e6 / (members.NUM_SAMPLES - 1))
    assert of_four == pytest.approx(alone / 4)
    assert found["`rod`, pose"] == [1e6, pytest.approx(2.5e5)]
