"""Identification (thesis eqs. 5.7-5.9): parameters from what the markers did under a command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import linalg

from diffsim.data.study import Run
from diffsim.identify import Fit, Problem, WhiteNoise, fit
from labs.loop.model import CHANNELS, Starfish, as_displacements

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """How parameters are fitted.

    Attributes:
        duration_s: Fitted length of every recording, from its start [s].
        sd_m: What a sample is trusted to [m]: far above the camera's noise, for what the model
            lacks is millimeters, and alike from sample to sample.
        method: "lbfgs" (as in the thesis, gradients by the simulator's adjoint) or "gauss_newton"
            (by its tangents).
        max_evaluations: Largest number of evaluations of the misfit, with its gradient.
    """

    duration_s: float = 6.0
    sd_m: float = 5e-3
    method: str = "lbfgs"
    max_evaluations: int = 25


@dataclass(frozen=True, kw_only=True)
class Identified:
    """Parameters with what is known of them."""

    values: dict[str, float]  # by name, clocks of runs included
    sd: dict[str, float]  # posterior standard deviations, by name; see :func:`identify`
    names: tuple[str, ...]  # order of ``correlation``
    correlation: list[list[float]]  # posterior, rows of lists
    # loss_before, loss_after: L_theta, thesis eq. 5.8, sum of squared displacement errors of the
    # markers at the start of the fit and at its end [m^2].
    loss_before: float
    loss_after: float
    # rms_before, rms_after: root mean square of a marker's coordinate [m]
    rms_before: float
    rms_after: float
    # at_bound, undetermined: names, as in :class:`diffsim.identify.Fit`
    at_bound: tuple[str, ...]
    undetermined: tuple[str, ...]
    num_evaluations: int  # number of evaluations of the misfit and its gradient
    message: str  # the solver's reason to stop
    spread: float  # factor on the variance of a sample, see :func:`identify`

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    @classmethod
    def from_plain(cls, saved: Mapping[str, Any]) -> Identified:
        """What ``plain`` made."""
        known: dict[str, Any] = dict(saved)
        for name in ("names", "at_bound", "undetermined"):
            known[name] = tuple(known[name])
        return cls(**known)


def identify(
    model: Starfish,
    runs: Sequence[Run],
    settings: FitSettings,
    *,
    start: Mapping[str, float] | None = None,
) -> Identified:
    """Most probable parameters given recordings.

    Standard deviations come from the Gauss-Newton matrix, with a sample's variance taken as the
    mean square that is left times the residuals' correlation length in samples (never less than
    ``sd_m`` squared): what the model lacks is no white noise.

    Args:
        model: Model with the priors of its parameters.
        runs: Recordings, each with a clock of its own.
        settings: Budget, method and trust of the fit.
        start: Parameters to start at, by name; where a clock or parameter is missing, its prior's.
    """
    cut = [as_displacements(run, settings.duration_s, settings.sd_m) for run in runs]
    channels = cut[0][1]
    sim = model.fit_model([run.name for run in runs])
    known = start or {}
    x = np.array([p.coordinate_of(known.get(p.name, p.value)) for p in sim.base])
    windows = [run for run, _ in cut]
    with torch.no_grad():
        problem = Problem(sim, tuple(windows), WhiteNoise(channels))
        before = problem.residual(x)
    found = fit(
        sim,
        windows,
        channels,
        method=settings.method,
        start=x,
        gradient="autograd",
        max_evaluations=settings.max_evaluations,
    )
    return _summarize_fit(found, before, settings.sd_m)


def loss_of(model: Starfish, run: Run, values: Mapping[str, float], duration_s: float) -> float:
    """L_theta [m^2] of a recording at given parameters; a missing clock counts as in time."""
    cut, channels = as_displacements(run, duration_s, 1.0)
    sim = model.fit_model([run.name])
    x = np.array([p.coordinate_of(values.get(p.name, p.value)) for p in sim.base])
    with torch.no_grad():
        residual = Problem(sim, (cut,), WhiteNoise(channels)).residual(x)
    return float(residual @ residual)


def _summarize_fit(found: Fit, before: Array, sd_m: float) -> Identified:
    spread = max(1.0, found.chi2 / found.num_samples * correlation_length(found.residual))
    n = len(found.x)
    covariance = linalg.inv(found.jacobian.T @ found.jacobian / spread + np.eye(n))
    prior = np.sqrt(np.diag(found.covariance))
    own = np.sqrt(np.diag(covariance))
    names = found.problem.names
    unit = {name: found.sd[name] / p for name, p in zip(names, prior, strict=True)}
    return Identified(
        values=dict(found.values),
        sd={name: float(unit[name] * s) for name, s in zip(names, own, strict=True)},
        names=names,
        correlation=(covariance / np.outer(own, own)).tolist(),
        loss_before=float(before @ before) * sd_m**2,
        loss_after=found.chi2 * sd_m**2,
        rms_before=float(np.sqrt(np.mean(before**2))) * sd_m,
        rms_after=float(np.sqrt(found.chi2 / found.num_samples)) * sd_m,
        at_bound=found.at_bound,
        undetermined=tuple(name for name, s in zip(names, own, strict=True) if s > 0.9),
        num_evaluations=found.num_evaluations,
        message=found.message,
        spread=spread,
    )


def correlation_length(residual: Array, num_channels: int = len(CHANNELS)) -> float:
    """1 + 2 sum of autocorrelations up to their first zero, mean over channels [samples].

    Args:
        residual: Residual of all valid samples, channels fastest; missing ones are passed over.
        num_channels: Number of channels that interleave.
    """
    rows = residual[: len(residual) // num_channels * num_channels].reshape(-1, num_channels)
    lengths = []
    for r in rows.T:
        power = np.abs(np.fft.rfft(r, 2 * len(r))) ** 2
        rho = np.fft.irfft(power)[: len(r)] / max(float(r @ r), 1e-300)
        below = np.flatnonzero(rho <= 0.0)
        lengths.append(1.0 + 2.0 * float(rho[1 : below[0] if len(below) else None].sum()))
    return float(np.mean(lengths))
