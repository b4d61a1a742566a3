"""Gate (a) of a diagnosis: the score of an effect by the adjoint and by differences."""

import numpy as np
import torch


def score_error(predict, effect, measured, sd, step=1e-3):
    """Largest relative error of the adjoint score d(-|r|^2 / 2) / d size at size 0.

    Differences of second order with steps of a share of the typical size: central where the effect
    is signed, upwards where it is not.
    """

    def loss(size):
        return -0.5 * (((measured - predict(size)) / sd) ** 2).sum()

    count = len(effect.components)
    size = torch.zeros(count, dtype=torch.float64, requires_grad=True)
    adjoint = torch.autograd.grad(loss(size), size)[0].numpy()
    h = step * effect.typical
    found = np.empty(count)
    with torch.no_grad():
        for i in range(count):
            unit = torch.zeros(count, dtype=torch.float64)
            unit[i] = h
            if effect.signed:
                found[i] = float(loss(unit) - loss(-unit)) / (2 * h)
            else:
                found[i] = float(4 * loss(unit) - loss(2 * unit) - 3 * loss(0 * unit)) / (2 * h)
    assert np.abs(found).max() > 0, "the effect does nothing here, so its score proves nothing"
    return np.abs(adjoint - found).max() / np.abs(found).max()


def typical(effect):
    """The effect's typical size."""
    return torch.full((len(effect.components),), effect.typical, dtype=torch.float64)
