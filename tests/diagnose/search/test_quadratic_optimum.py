"""The minimum of a quadratic within bounds, singular ones too."""

import numpy as np
import pytest

from diffsim.diagnose.search.optimum import quadratic_optimum

NONE = np.full(2, np.inf)


def test_two_sizes_that_do_the_same_share_it():
    # twins of 1e12 noise units, whose priors of 1e-6 are lost in rounding
    hessian = 1e12 * np.ones((2, 2)) + 1e-6 * np.eye(2)
    v = quadratic_optimum(hessian, np.array([3e12, 3e12]), -NONE, NONE)
    assert v == pytest.approx([1.5, 1.5])


def test_the_bound_of_one_twin_leaves_the_rest_to_the_other():
    hessian = 1e12 * np.ones((2, 2)) + 1e-6 * np.eye(2)
    v = quadratic_optimum(hessian, np.array([3e12, 3e12]), -NONE, np.array([0.5, np.inf]))
    assert v.sum() == pytest.approx(3.0) and v[0] <= 0.5
