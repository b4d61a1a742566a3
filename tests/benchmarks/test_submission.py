"""Results in the form of ``nonlinear_benchmarks``: scored by the package's own code."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.submission import FORMS, official_test, score


def test_the_number_is_the_root_behind_the_window_and_in_the_stated_unit():
    pytest.importorskip("nonlinear_benchmarks", reason="nonlinear_benchmarks makes the number")
    truth = np.zeros(100)
    predicted = np.where(np.arange(100) < FORMS["emps"].window, 1.0e3, 2.0e-3)
    found = score("emps", truth, truth, predicted, 1.0e-3)
    assert found["value"] == pytest.approx(2.0)  # mm
    assert found["mean_square"] == pytest.approx(4.0)
    assert (found["benchmark"], found["unit"]) == ("EMPS", "mm")


def test_official_data_bring_their_own_window(monkeypatch):
    """The stated window is that of one version; the package at hand may have another."""

    class Data(SimpleNamespace):
        def __iter__(self):
            return iter((self.u, self.y))

    test = Data(
        u=np.zeros(6), y=np.ones(6), sampling_time=4.0, state_initialization_window_length=5
    )
    package = SimpleNamespace(Cascaded_Tanks=lambda: (None, test))
    monkeypatch.setitem(sys.modules, "nonlinear_benchmarks", package)
    time, _, out, window = official_test("cascaded_tanks")
    assert (time[-1], out.sum(), window) == (20.0, 6.0, 5)
    assert window != FORMS["cascaded_tanks"].window
