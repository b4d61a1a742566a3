"""Values of many base parameters at a point, made when they are asked for."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from diffsim.identify import Parameter
from diffsim.identify.model import BaseValues

BASE = (
    Parameter("mass", 1.5, 0.1, "kg", log=True, lower=0.2),
    Parameter("zero", 0.0, 2.0, lower=-1.0, upper=3.0),
    Parameter("gain", 4.0, 0.3),
    Parameter("drag", 0.2, 1.0, log=True),
)


@pytest.mark.parametrize("shape", [(4,), (5, 4)])
def test_values_are_those_of_each_parameter(shape):
    q = torch.from_numpy(np.random.default_rng(0).normal(size=shape))
    at = BaseValues(BASE).at(q)
    assert list(at) == [p.name for p in BASE] and len(at) == 4
    for i, p in enumerate(BASE):
        assert p.name in at and torch.equal(at[p.name], p.value_at(q[..., i]))
    assert "speed" not in at and "speed" not in {**at}
    with pytest.raises(KeyError, match="speed"):
        at["speed"]


def test_a_slope_by_one_value_reaches_its_coordinate_alone():
    q = torch.zeros(4, dtype=torch.float64, requires_grad=True)
    (grad,) = torch.autograd.grad(BaseValues(BASE).at(q)["drag"], q)
    assert grad.tolist() == [0.0, 0.0, 0.0, 0.2]  # d exp(q) 0.2


def test_bounds_are_those_in_standardized_coordinates():
    values = BaseValues(BASE)
    assert values.low == pytest.approx([np.log(0.2 / 1.5) / 0.1, -0.5, -np.inf, -np.inf])
    assert values.high == pytest.approx([np.inf, 1.5, np.inf, np.inf])
