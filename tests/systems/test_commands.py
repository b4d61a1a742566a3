"""Commands as tensors: straight lines between points, as numpy has them, with gradients."""

import numpy as np
import pytest
import torch

from diffsim.data.study import Run
from diffsim.systems.commands import command_of, interpolated

PLACES, VALUES = np.array([0.0, 0.5, 2.0]), np.array([1.0, -1.0, 4.0])


def test_straight_lines_are_numpys_held_beyond_the_ends():
    at = torch.linspace(-1.0, 3.0, 41, dtype=torch.float64)
    wanted = np.interp(at.numpy(), PLACES, VALUES)
    np.testing.assert_array_equal(interpolated(at, PLACES, VALUES), wanted)
    values = torch.from_numpy(VALUES).requires_grad_()
    np.testing.assert_allclose(interpolated(at, PLACES, values).detach(), wanted, atol=1e-14)


@pytest.mark.grad
def test_gradient_of_places_and_values():
    at = torch.tensor([-0.3, 0.2, 0.7, 1.9, 2.5], dtype=torch.float64, requires_grad=True)
    values = torch.from_numpy(VALUES).requires_grad_()
    assert torch.autograd.gradcheck(lambda a, v: interpolated(a, PLACES, v), (at, values))


def test_an_unknown_command_is_named():
    run = Run("a", np.arange(3.0), np.zeros((3, 1)), {"force": np.ones(3)}, "a")
    assert command_of(run, "force").tolist() == [1.0, 1.0, 1.0]
    with pytest.raises(ValueError, match="force"):
        command_of(run, "forse")
