"""benchmarks/reference_numbers.py: every bit is shown, runs repeat, what fails is said."""

import os

import numpy as np
import pytest
import torch

from benchmarks import reference_numbers, reference_systems
from benchmarks.listed_studies import sources
from benchmarks.reference_values import lines_of
from diffsim.diagnose import diagnose


@pytest.fixture(autouse=True)
def environment(monkeypatch):
    """The command sets threads and progress of its own process: here, of all tests after it."""
    monkeypatch.setattr(os, "environ", os.environ.copy())


def test_lines_change_with_the_last_bit():
    value, next_one = 0.1, float(np.nextafter(0.1, 1.0))
    assert list(lines_of("x", value)) == ["x = 0.1"]
    for make in (
        float,
        lambda v: torch.full((3,), v),
        lambda v: np.full(50, v),
        lambda v: [v] * 20,
    ):
        assert list(lines_of("x", make(value))) == list(lines_of("x", make(value)))
    for make in (float, lambda v: [v], lambda v: np.full(50, v)):
        assert list(lines_of("x", make(value))) != list(lines_of("x", make(next_one)))


def test_lines_name_every_part():
    nested = {"a": {"loss": torch.tensor(2.0).double(), "ok": True}, "b": None, "c": ["u", "v"]}
    nested["d"] = [2.5, "sd"]
    assert list(lines_of("x", nested)) == [
        "x/a/loss = 2.0",
        "x/a/ok = True",
        "x/b = None",
        "x/c = ['u', 'v']",
        "x/d/0 = 2.5",
        "x/d/1 = 'sd'",
    ]
    (line,) = lines_of("x", np.array([3.0, 4.0, np.nan] + [0.0] * 20))
    assert line.startswith("x = shape [23], norm 5.0, sha256 ")
    (line,) = lines_of("x", torch.arange(20))
    assert line.startswith("x = shape [20], norm ")
    with pytest.raises(TypeError, match="x/y must be numbers"):
        list(lines_of("x", {"y": object()}))


def test_a_run_repeats_itself_and_goes_to_a_file(tmp_path, capsys):
    first, second = tmp_path / "first.txt", tmp_path / "second.txt"
    for path in (first, second):
        assert (
            reference_numbers.main(["--only", "statics", "recording_fit", "--out", str(path)]) == 0
        )
    assert first.read_text() == second.read_text()
    assert first.read_text().strip() in capsys.readouterr().out
    assert "# instruction_set: " in first.read_text()
    assert "statics/pd/loss = " in first.read_text()


def test_what_fails_is_said_and_hides_nothing():
    def broken():
        raise ImportError("it has moved")

    lines, complete = reference_numbers.results("broken", broken)
    assert not complete
    assert lines[-1] == "broken = not computed: ImportError: it has moved"


def test_unknown_items_are_refused(capsys):
    with pytest.raises(SystemExit):
        reference_numbers.main(["--only", "cantilevre"])
    assert "choose from cantilever" in capsys.readouterr().err


def test_a_diagnosis_is_read_as_it_is_written():
    """A report that lost a key once left four items without numbers."""
    study, setup = sources()["rates/load_cell"]()
    few = setup.effects[:2]
    report = diagnose(study, setup.model, few, seed=0, settings=setup.settings).to_dict()
    lines = list(lines_of("x", reference_systems.of_report(report)))
    assert f"x/verdict = {report['verdict']!r}" in lines
    assert f"x/work/simulations = {report['settings']['work']['simulations']}" in lines
    assert all(f"x/effects/{effect.name}/nats" in " ".join(lines) for effect in few)
