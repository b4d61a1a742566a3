"""Common times and release shift: each with an answer known beforehand."""

import numpy as np
import pytest
import torch

from examples.demo.tip_window import Window, rms, sampling_matrix, window


def motion(t, release=0.0):
    s = np.clip(t - release, 0, None)
    z = -6e-3 * (1 - np.exp(-2.6 * s) * np.cos(48.6 * s))
    return np.column_stack([0 * z, 0 * z, z])


@pytest.mark.parametrize("release", [-0.0073, 0.0, 0.0042])
def test_best_shift_finds_when_the_hand_let_go(release):
    time_s = np.arange(0, 1.0, 0.01) + 0.004
    measured = window(time_s, motion(time_s, release), until_s=1.0)
    model_time = np.arange(0, 1.0 + 1e-9, 0.002)
    model = torch.from_numpy(motion(model_time))
    shift = measured.best_shift(model_time, model)
    assert shift == pytest.approx(release, abs=1e-5)
    total, per_axis = rms(measured.residual(model_time, model, shift))
    assert total == pytest.approx(per_axis[2]) and total < 2e-5  # kink at release, step 2 ms
    if release:
        assert rms(measured.residual(model_time, model))[0] > 10 * total


def test_interpolation_does_not_add_damping():
    coarse = np.arange(0, 1.0 + 1e-9, 0.01)
    fine = np.arange(0.1, 0.9, 0.0037)
    x = np.cos(48.6 * coarse)
    # at 13 steps per cycle a straight line between steps would be off by (w h)^2 / 8 = 3 %
    np.testing.assert_allclose(sampling_matrix(coarse, fine) @ x, np.cos(48.6 * fine), atol=2e-3)


def test_nothing_is_extrapolated():
    with pytest.raises(ValueError, match=r"exceed the simulated \[0, 0.5\] s; simulate longer"):
        sampling_matrix(np.linspace(0, 0.5, 50), np.linspace(0, 0.6, 60))


@pytest.mark.grad
def test_gradient_passes_to_the_model():
    time_s = np.arange(0.001, 0.2, 0.01)
    measured = Window(time_s, motion(time_s))
    model_time = np.arange(0, 0.25, 0.01)
    model = torch.from_numpy(motion(model_time)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: measured.residual(model_time, x, 0.003), model)
