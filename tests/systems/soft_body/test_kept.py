"""What forces compute once: as computed in every step, to the last bit."""

import numpy as np
import torch

from diffsim.systems.soft_body.kept import OfScene, OfTime, ratio
from diffsim.systems.soft_body.scene import Moment

X = torch.zeros(1, 3, dtype=torch.float64)


def moment(time, dt=1e-3):
    return Moment(X, X, time, dt)


def test_a_signal_of_time_is_that_of_the_times_of_steps():
    asked = []

    def signal(times):
        asked.append(len(times))
        return torch.stack([times.sin(), times**2], -1)

    kept, start = OfTime(signal), 0.1
    for k in range(600):  # over the seams of what is computed at a time
        time = start + k * 1e-3
        alone = signal(torch.tensor([time], dtype=torch.float64))[0]
        asked.pop()
        assert torch.equal(kept(moment(time)), alone)
    assert max(asked) < 600
    assert sum(asked) < 2 * 600


def test_moments_out_of_step_are_computed_alone():
    kept = OfTime(lambda times: times[:, None])
    times = [0.0, 1e-3, 2.5e-3, 9.0, -1.0, 2e-3]
    np.testing.assert_array_equal([float(kept(moment(t))) for t in times], times)


def test_a_signal_of_time_has_its_gradient():
    size = torch.ones((), dtype=torch.float64, requires_grad=True)
    kept = OfTime(lambda times: size * times)
    (kept(moment(0.0)) + kept(moment(1e-3)) + kept(moment(2e-3))).backward()
    assert float(size.grad) == 3e-3


def test_a_value_of_a_scene_is_that_of_the_scene_that_is_asked_for():
    made = []
    kept = OfScene(lambda scene: made.append(scene) or len(scene))
    first, second = [1.0], [1.0, 2.0]
    assert (kept(first), kept(first), kept(second), kept(first)) == (1, 1, 2, 1)
    assert made == [first, second, first]


def test_a_ratio_is_that_of_multiples_alone():
    one = torch.tensor([1.0, -2.0, 0.0], dtype=torch.float64)
    assert float(ratio(one, -3.0 * one)) == -3.0
    assert float(ratio(one, 0.0 * one)) == 0.0
    assert ratio(one, one + 1e-9) is None
    assert ratio(one, one[:2]) is None
    assert ratio(0.0 * one, one) is None
