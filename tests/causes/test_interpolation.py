"""Values between samples: their slopes at the ends, where a command often rests."""

import pytest
import torch

from diffsim.causes.interpolation import curved


@pytest.mark.grad
@pytest.mark.parametrize("at", [-0.3, 0.0, 0.7, 2.0, 7.0, 7.4])
def test_slopes_by_place_are_those_of_differences(at):
    """At the first sample it was twice the slope: that of the curve, and of the line before it."""
    values = torch.sin(torch.linspace(0.0, 3.0, 8, dtype=torch.float64))[:, None]

    def shown(place):
        return curved(values, 0.5, 0.5 * place)[:, 0]

    place = torch.tensor([at], dtype=torch.float64)
    slope = torch.autograd.functional.jacobian(shown, place)[0, 0]
    rise = (shown(place + 1e-6) - shown(place - 1e-6)) / 2e-6
    assert float(slope) == pytest.approx(float(rise), rel=1e-6)
