"""Simulated against measured tip motion: markers on a mesh, common times, what is left.

Everything here is linear in the simulated node positions, so gradients pass through.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import interpolate, optimize
from torch import Tensor

Array = NDArray[np.float64]

MAX_RELEASE_SHIFT_S = 0.01  # one camera frame: nobody knows better when the hand let go


def sampling_matrix(model_time_s: Array, time_s: Array) -> Array:
    """(len(time_s), len(model_time_s)): cubic spline from model steps to measured times.

    Times outside the model's are refused: nothing is extrapolated.
    """
    if time_s[0] < model_time_s[0] - 1e-12 or time_s[-1] > model_time_s[-1] + 1e-12:
        raise ValueError(
            f"measured times [{time_s[0]:.4g}, {time_s[-1]:.4g}] s exceed the simulated "
            f"[{model_time_s[0]:.4g}, {model_time_s[-1]:.4g}] s; simulate longer"
        )
    spline = interpolate.CubicSpline(model_time_s, np.eye(len(model_time_s)), bc_type="natural")
    return np.asarray(spline(time_s))


@dataclass(frozen=True)
class Window:
    """Measured tip motion on a stretch of time, to be compared with a simulation."""

    time_s: Array  # times since the release, (N,) [s]
    tip_m: Array  # (N, 3) displacement from the held state [m]

    def residual(self, model_time_s: Array, model_tip_m: Tensor, shift_s: float = 0.0) -> Tensor:
        """(N, 3) simulated minus measured [m]; the model is released ``shift_s`` later.

        Before its own release the model is held: displacement zero.
        """
        asked = self.time_s - shift_s
        matrix = sampling_matrix(model_time_s, np.clip(asked, model_time_s[0], None))
        matrix[asked < model_time_s[0]] = 0.0
        return torch.from_numpy(matrix) @ model_tip_m - torch.from_numpy(self.tip_m)

    def best_shift(self, model_time_s: Array, model_tip_m: Tensor) -> float:
        """Release shift within one camera frame that fits the vertical motion best [s]."""
        z = interpolate.CubicSpline(model_time_s, model_tip_m.detach().numpy()[:, 2])

        def cost(shift: float) -> float:
            asked = self.time_s - shift
            simulated = np.where(asked < 0, 0.0, z(np.clip(asked, 0.0, model_time_s[-1])))
            return float(np.mean((simulated - self.tip_m[:, 2]) ** 2))

        bound = min(MAX_RELEASE_SHIFT_S, float(model_time_s[-1] - self.time_s[-1]))
        shifts = np.linspace(-bound, bound, 9)
        start = shifts[int(np.argmin([cost(s) for s in shifts]))]
        step = shifts[1] - shifts[0] if bound > 0 else 0.0
        solution = optimize.minimize_scalar(
            cost, bounds=(max(start - step, -bound), min(start + step, bound)), method="bounded"
        )
        return float(solution.x) if bound > 0 else 0.0


def window(time_s: Array, tip_m: Array, until_s: float) -> Window:
    """The part from release to ``until_s``, with room left for the release shift."""
    inside = (time_s >= 0.0) & (time_s <= until_s - MAX_RELEASE_SHIFT_S)
    return Window(time_s[inside], tip_m[inside])


def rms(residual: Tensor) -> tuple[float, Array]:
    """Root mean square length of the residual vector, and per axis [m]."""
    per_axis = residual.detach().pow(2).mean(dim=0).sqrt().numpy()
    return float(np.sqrt(np.sum(per_axis**2))), per_axis
