"""The toy's steps in C++ are those in NumPy."""

import numpy as np
import pytest

from tests.diagnose import toy_steps

pytestmark = pytest.mark.skipif(toy_steps.compiled() is None, reason="needs a C++ compiler")
RNG = np.random.default_rng(0)
PUSH = RNG.normal(size=(3, 81))


def test_steps_of_fourth_order():
    terms = np.abs(RNG.normal(size=(3, 5))) * [90.0, 1.5, 0.1, 0.3, 1.0]
    terms[0, 2:] = 0.0
    for got, expected in zip(
        toy_steps.rk4(terms, PUSH, 0.02), toy_steps.rk4_in_numpy(terms, PUSH, 0.02), strict=True
    ):
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("substeps", [1, 3])
def test_implicit_steps(substeps):
    terms = np.array([[9.0, 0.08], [9.5, 0.1], [8.0, 0.0]])
    given = (terms, PUSH, 0.02 / substeps, substeps)
    for got, expected in zip(
        toy_steps.implicit_euler(*given), toy_steps.implicit_euler_in_numpy(*given), strict=True
    ):
        np.testing.assert_array_equal(got, expected)
