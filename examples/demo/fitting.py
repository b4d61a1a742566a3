"""Young's modulus from the sag, Young's modulus and damping from the motion: all by gradient."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from examples.data.beam import BeamGeometry, BeamTrial
from examples.demo.beam import Beam, Setup
from examples.demo.identify import Unknown, fit
from examples.demo.plan import Plan
from examples.demo.tip_window import MAX_RELEASE_SHIFT_S, window
from examples.demo.workers import Workers

Residual = Callable[[Mapping[str, Tensor]], Tensor]
LOW_PA, HIGH_PA = 20e3, 5e6
DAMPING = {  # start and bounds of the damping coefficients
    "rayleigh_beta": Unknown(start=1e-3, low=1e-5, high=2e-2, unit="s", step=0.3),
    "rayleigh_alpha": Unknown(start=1.0, low=1e-2, high=3e1, unit="1/s", step=0.3),
}


def fit_sag(bar: BeamGeometry, setup: Setup, sag_m: float, *, rtol: float = 1e-6) -> dict[str, Any]:
    """Young's modulus whose static sag is the measured one: Newton on log sag over log E."""
    beam = Beam(bar, setup)
    log_e = float(np.log(bar.youngs_modulus_published_Pa))
    history = []
    for _ in range(12):
        leaf = torch.tensor(log_e, dtype=torch.float64, requires_grad=True)
        miss = torch.log(beam.sag({"youngs_modulus": leaf.exp()}) / sag_m)
        (slope,) = torch.autograd.grad(miss, leaf)
        off = float(miss.detach())
        history.append(
            {"youngs_modulus": float(np.exp(log_e)), "sag_m": sag_m * float(np.exp(off))}
        )
        if abs(off) < rtol:
            break
        log_e -= off / float(slope)  # slope is -1 for a linear bar
    return {"youngs_modulus": history[-1]["youngs_modulus"], "target_m": sag_m, "history": history}


def fit_motion(
    bar: BeamGeometry,
    setup: Setup,
    trials: Sequence[tuple[BeamTrial, float]],
    plan: Plan,
    workers: Workers,
    *,
    start: Mapping[str, float],
    damping: Sequence[str],
) -> dict[str, Any]:
    """Least squares of the vertical tip motion over the first ``plan.fit_s`` seconds.

    Each trial's residual is divided by its repeat floor, so that a trial counts by what its
    repeat confirms; its release may shift by one camera frame, chosen anew in every evaluation
    (the cost is least there, so the gradient needs no term for it).

    Args:
        bar, setup: What is simulated.
        trials: (trial, floor [m]).
        plan, workers: Sizes and threads.
        start: Values to start from, ``youngs_modulus`` at least.
        damping: Names of the damping coefficients to fit.

    Returns:
        The fit as plain numbers.
    """
    unknowns = {
        "youngs_modulus": Unknown(
            start=start["youngs_modulus"], low=LOW_PA, high=HIGH_PA, unit="Pa", step=0.03
        )
    }
    for name in damping:
        standard = DAMPING[name]
        unknowns[name] = Unknown(
            start=start.get(name, standard.start),
            low=standard.low,
            high=standard.high,
            unit=standard.unit,
            step=standard.step,
        )

    def residual_of(trial: BeamTrial, floor_m: float) -> Residual:
        measured = window(trial.time_s, trial.tip_displacement_m, plan.fit_s)

        def residual(parameters: Mapping[str, Tensor]) -> Tensor:
            beam = Beam(bar, setup, trial.tip_load_mass_kg)  # its own: threads share nothing
            run = beam.release(parameters, plan.fit_s, tick=workers.tick)
            shift = measured.best_shift(run.time_s, run.tip_m)
            return measured.residual(run.time_s, run.tip_m, shift)[:, 2] / floor_m

        return residual

    found = fit(
        [residual_of(trial, floor) for trial, floor in trials],
        unknowns,
        max_evaluations=plan.max_evaluations,
        rtol=1e-4,  # far above the noise of steps solved to 1e-5
        run=workers.run,
    )
    return {
        "fitted_on": [trial.name for trial, _ in trials],
        "window_s": plan.fit_s - MAX_RELEASE_SHIFT_S,
        "value": found.value,
        "std": found.std,
        "unit": {name: unknown.unit for name, unknown in unknowns.items()},
        "start": {name: unknown.start for name, unknown in unknowns.items()},
        "correlation": found.correlation,
        "undetermined": list(found.undetermined),
        "history": found.history,
        "num_evaluations": found.num_evaluations,
    }
