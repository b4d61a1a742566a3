"""Formulas of columns: derivatives, and words in backquotes."""

import numpy as np
import pytest

from diffsim.data.formula import evaluate, names_in

CLOCK = np.array([0.0, 0.1, 0.3, 0.4, 0.7])  # uneven, as logs are


def formula(text: str, **columns: np.ndarray) -> np.ndarray:
    return evaluate(text, CLOCK, lambda name: columns[name.replace(" ", "_")], ["v", "v x"])


def test_the_derivative_of_a_parabola_is_exact_between_the_ends():
    found = formula("2*derivative(v) + 1", v=3.0 * CLOCK**2)
    np.testing.assert_allclose(found[1:-1], 12.0 * CLOCK[1:-1] + 1.0, rtol=1e-12)


def test_a_derivative_takes_words_in_backquotes_beside_the_column_itself():
    found = formula("derivative( `v x` ) - `v x`", v_x=5.0 * CLOCK)
    np.testing.assert_allclose(found, 5.0 - 5.0 * CLOCK, rtol=1e-12)
    assert set(names_in("derivative(`v x`) - v")) == {"v x", "v"}


def test_a_fact_has_no_derivative():
    with pytest.raises(ValueError, match="needs a column with two rows"):
        evaluate("derivative(v)", CLOCK, lambda name: 3.0, ["v"])


def test_a_derivative_of_a_formula_is_refused():
    with pytest.raises(ValueError, match="derivative"):
        formula("derivative(2*v)", v=CLOCK)
