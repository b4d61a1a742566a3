"""Results in the form of ``nonlinear_benchmarks``: scored by the package's own code."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.submission import FORMS, score


def test_the_number_is_the_root_behind_the_window_and_in_the_stated_unit():
    pytest.importorskip("nonlinear_benchmarks", reason="nonlinear_benchmarks makes the number")
    truth = np.zeros(100)
    predicted = np.where(np.arange(100) < FORMS["emps"].window, 1.0e3, 2.0e-3)
    found = score("emps", truth, truth, predicted, 1.0e-3)
    assert found["value"] == pytest.approx(2.0)  # mm
    assert found["mean_square"] == pytest.approx(4.0)
    assert (found["benchmark"], found["unit"]) == ("EMPS", "mm")
