"""Reference results of everything that drives an optimizer: short runs, evaluation by evaluation.

What ends a run early belongs to it: a budget of evaluations, a point whose simulation fails, an
interruption after which a record on file is gone on from.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import Tensor

F64 = torch.float64


def _falling_bar() -> Any:
    """An application whose truth is known: a bar falls; its stiffness and its weight are sought."""
    from diffsim import mesh, soft
    from examples.applications import Application, Parameters, solver_options

    box = mesh.hex_box((3, 1, 1), (0.06, 0.02, 0.02))
    body = soft.SoftBody(
        box,
        dt=0.01,
        youngs_modulus=1e5,
        poissons_ratio=0.4,
        fixed=box.nodes_near_plane("x", 0.0),
        solver=solver_options("projective_dynamics", rtol=1e-10, num_threads=1),
    )

    def simulate(p: Tensor) -> Tensor:
        pull = torch.cat([torch.zeros(2, dtype=F64), p[1:]])
        physics = body.physics(youngs_modulus=p[0].exp(), gravity=pull)
        return soft.rollout(body, body.rest_state(), 10, physics=physics).x

    with torch.no_grad():
        target = simulate(torch.tensor([np.log(2e5), -3.0], dtype=F64))
    return Application(
        name="bar",
        title="",
        source="",
        body=body,
        parameters=Parameters(
            names=("log E", "g"),
            lower=np.array([np.log(5e4), -8.0]),
            upper=np.array([np.log(8e5), -1.0]),
            first=np.array([np.log(1e5), -6.0]),
        ),
        simulate=simulate,
        loss=lambda _p, x: (x - target).square().sum(),
        numbers=lambda values, _x: {"E": float(np.exp(values[0]))},
    )


def application_search() -> Mapping[str, Any]:
    """Applications' L-BFGS: from a guess, from random starts, warmed up, with failures, resumed."""
    from diffsim.core.errors import ConvergenceError
    from examples.applications import minimize

    bar = _falling_bar()

    def fragile(p: Tensor) -> Tensor:
        if float(p[1].detach()) > -4.0:  # beyond the first guess, before the truth
            raise ConvergenceError("made up", residual_norm=1.0, tolerance=0.1, num_iters=3)
        return bar.simulate(p)

    cases = {
        "whole": minimize(bar, max_evaluations=40),
        "budget": minimize(bar, max_evaluations=7),
        "starts": minimize(replace(bar, num_starts=4), max_evaluations=5, seed=3),
        "warm_up": minimize(replace(bar, warm_up=bar), max_evaluations=5),
        "failing": minimize(replace(bar, simulate=fragile), max_evaluations=12),
    }
    with TemporaryDirectory() as folder:
        record = Path(folder) / "bar.jsonl"
        minimize(bar, max_evaluations=4, record=record)
        cases["resumed"] = minimize(bar, max_evaluations=7, record=record)
    return {
        name: {
            "evaluations": len(outcome.evaluations),
            "converged": outcome.converged,
            "message": outcome.message,
            "best": outcome.best.values,
            "loss": outcome.best.loss,
            "losses": [e.loss for e in outcome.evaluations],
            "values": [e.values for e in outcome.evaluations],
            "gradients": [e.gradient for e in outcome.evaluations],
        }
        for name, outcome in cases.items()
    }


def _of_optimum(best: Any) -> dict[str, Any]:
    return {
        "evaluations": len(best.evaluations),
        "message": best.message,
        "best": best.x,
        "loss": best.loss,
        "unit": best.unit_loss,
        "losses": best.evaluation_losses,
        "designs": best.evaluations,
        "samples": best.sample_losses,
        "rejected": best.num_rejected,
    }


def device_search() -> Mapping[str, Any]:
    """Devices' L-BFGS: after samples, resumed, with designs that have no flow, coarse to fine."""
    from diffsim.stokes import devices

    finer, coarse = devices.make("amplifier", 0.375), devices.make("amplifier", 0.25)
    walls = coarse.states[0].shape

    def no_narrow_ones(x: Tensor) -> Any:
        if float(x[4]) > 0.36:
            raise ValueError("closed")
        return walls(x)

    fussy = replace(coarse, states=(replace(coarse.states[0], shape=no_narrow_ones),))
    whole = devices.optimize(coarse, 6, seed=0, max_evaluations=50, progress=False)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "log.json"
        devices.optimize(coarse, 6, seed=0, max_evaluations=5, path=path, progress=False)
        again = devices.optimize(coarse, 6, seed=0, max_evaluations=9, path=path, progress=False)
    stages = devices.coarse_to_fine(
        finer,
        coarse,
        6,
        num_starts=2,
        num_checked=3,
        max_evaluations=8,
        max_coarse_evaluations=8,
        progress=False,
    )
    assert stages.coarse is not None
    descents = stages.coarse.descents
    return {
        "whole": _of_optimum(whole),
        "resumed": _of_optimum(again),
        "fussy": _of_optimum(
            devices.optimize(fussy, 6, seed=1, max_evaluations=12, progress=False)
        ),
        "coarse_to_fine": {
            **_of_optimum(stages),
            "coarse_losses": torch.cat([d.losses for d in descents]),
            "coarse_messages": [d.message for d in descents],
        },
    }


TIME = np.linspace(0.0, 2.0, 30)


@dataclass(frozen=True)
class Decay:
    """height exp(-rate t); cannot be simulated where the height is below ``lowest``."""

    height: Tensor
    rate: Tensor
    lowest: float = -np.inf

    def simulate(self) -> Tensor:
        """(30, 1) samples, or a failure."""
        from diffsim.core.errors import DiffsimError

        if float(self.height.detach().min()) < self.lowest:
            raise DiffsimError("too low")
        height, rate = self.height[..., None], self.rate[..., None]
        return (height * torch.exp(-rate * torch.from_numpy(TIME)))[..., None]


def recording_fit() -> Mapping[str, Any]:
    """Fits to recordings: Gauss-Newton, L-BFGS by both gradients, random starts and descents."""
    from diffsim.data import Channel, Run
    from diffsim.identify import Parameter, Problem, SimModel, WhiteNoise, fit
    from labs.balls.multi_start import descend, random_starts

    noise = 0.01 * np.random.default_rng(0).standard_normal((len(TIME), 1))
    run = Run("only", TIME, (2.5 * np.exp(-0.6 * TIME))[:, None] + noise, {}, "only")
    channels = [Channel("y", "m", "position", 0.01)]
    base = [Parameter("height", 1.0, 1.0, "m"), Parameter("rate", 1.0, 0.5, "1/s", log=True)]

    def model(lowest: float = -np.inf) -> Any:
        return SimModel(lambda v, _run, _n: Decay(v["height"], v["rate"], lowest), base)

    def problem(lowest: float = -np.inf) -> Any:
        return Problem(model(lowest), (run,), WhiteNoise(channels))

    found: dict[str, Any] = {}
    fits: dict[str, dict[str, Any]] = {
        "gauss_newton": {},
        "lbfgs_differences": {"method": "lbfgs"},
        "lbfgs_autograd": {"method": "lbfgs", "gradient": "autograd"},
        "budget": {"method": "lbfgs", "gradient": "autograd", "max_evaluations": 4},
    }
    for name, options in fits.items():
        made = fit(model(), (run,), channels, **options)
        found[name] = {
            "evaluations": made.num_evaluations,
            "message": made.message,
            "x": made.x,
            "sd": dict(made.sd),
            "chi2": made.chi2,
            "jacobian": made.jacobian,
        }
    starts = random_starts(problem(lowest=0.5), 12, seed=3)
    found["starts"] = {"x": starts.x, "cost": starts.cost}
    for name, lowest, budget, first_step in (
        ("descent", -np.inf, 40, 0.5),
        ("descent_budget", -np.inf, 3, 0.5),
        ("descent_failing", 0.9, 30, 1e3),
    ):
        down = descend(
            problem(lowest), np.array([0.0, 1.5]), max_evaluations=budget, first_step=first_step
        )
        found[name] = {
            "evaluations": len(down.cost),
            "message": down.message,
            "x": down.x,
            "cost": down.cost,
        }
    return found


def demo_fit() -> Mapping[str, Any]:
    """The demo's bounded L-BFGS over logarithms, on one mode of a beam."""
    from examples.demo.identify import Unknown, fit

    time = torch.arange(0, 2, 0.01, dtype=F64)

    def oscillator(p: Mapping[str, Tensor]) -> Tensor:
        w = torch.sqrt(p["youngs_modulus"] / 300e3) * 48.7
        sigma = 0.5 * p["rayleigh_beta"] * w**2
        swing = 1.0 - torch.exp(-sigma * time) * torch.cos(w * time)
        return -1785.0 / p["youngs_modulus"] * swing

    truth = {"youngs_modulus": 301e3, "rayleigh_beta": 2.2e-3}
    noise = 2e-5 * np.random.default_rng(0).standard_normal(len(time))
    target = oscillator({k: torch.tensor(v, dtype=F64) for k, v in truth.items()})
    target = target + torch.from_numpy(noise)
    unknowns = {
        "youngs_modulus": Unknown(start=280e3, low=50e3, high=2e6, unit="Pa"),
        "rayleigh_beta": Unknown(start=5e-4, low=1e-6, high=1e-1, unit="s"),
    }

    def residual(p: Mapping[str, Tensor]) -> Tensor:
        return oscillator(p) - target

    found = {}
    for name, trials, budget in (("whole", residual, 30), ("two", [residual] * 2, 4)):
        made = fit(trials, unknowns, max_evaluations=budget)
        found[name] = {
            "evaluations": made.num_evaluations,
            "value": made.value,
            "std": made.std,
            "correlation": made.correlation,
            "rms": [step["rms"] for step in made.history],
        }
    return found


def trajectory_search() -> Mapping[str, Any]:
    """Sim to real: the starfish's command by L-BFGS, and its parameters from a recording."""
    from diffsim.data import Run
    from labs.loop import (
        Command,
        FitSettings,
        Limits,
        Starfish,
        TrajectorySettings,
        identify,
        optimize,
    )

    model = Starfish()
    guesses = {p.name: p.value for p in model.parameters}
    pull = 0.005 * (1.0 - np.cos(2.0 * np.pi * np.arange(24) / 24))
    best = optimize(
        model,
        guesses,
        Command(pull),
        Limits(contraction_m=0.012, rate_m_s=0.15),
        TrajectorySettings(periods=1, num_knots=12, max_evaluations=6),
    )
    truth = guesses | {"youngs_modulus": 6e5, "drag_4": 2.6}
    with torch.no_grad():
        places = model.motion(truth, torch.from_numpy(pull)).numpy()
    run = Run(
        "run_0", np.arange(24) / 60.0, places[:, :-1], {"tendon_contraction_m": pull}, "run_0"
    )
    found: dict[str, Any] = {
        "command": {
            "evaluations": best.num_evaluations,
            "message": best.message,
            "loss_before": best.loss_before,
            "loss_after": best.loss_after,
            "contraction": best.command.contraction_m,
        }
    }
    for method in ("lbfgs", "gauss_newton"):
        settings = FitSettings(duration_s=0.4, sd_m=2e-4, method=method, max_evaluations=4)
        made = identify(model, [run], settings)
        found[method] = {
            "evaluations": made.num_evaluations,
            "message": made.message,
            "loss_before": made.loss_before,
            "loss_after": made.loss_after,
            "values": made.values,
            "sd": made.sd,
        }
    return found


def open_loop_search() -> Mapping[str, Any]:
    """Open-loop controllers by L-BFGS: a sinusoid and knots, for a copter and a swimmer."""
    from diffsim.envs import make_task
    from diffsim.learn.open_loop import fit_open_loop, make_open_loop

    found = {}
    cases: list[tuple[str, str, dict[str, Any]]] = [
        ("CopterHover", "knots", {"seconds": 0.3}),
        ("StarfishSwim", "sinusoid", {"robot": {"coarse": True}, "num_steps": 12}),
    ]
    for task_name, kind, options in cases:
        task = make_task(task_name, **options)
        controller = make_open_loop(kind, task, 0)
        made = fit_open_loop(task, controller, seed=0, batch=2, max_iterations=6)
        found[f"{task_name}/{kind}"] = {
            "evaluations": made.num_evaluations,
            "message": made.message,
            "loss": made.final.value,
            "parameters": made.final.x,
        }
    return found


def training() -> Mapping[str, Any]:
    """Some updates of every training method that needs no further package."""
    from diffsim.learn.methods import make_learner
    from diffsim.learn.run import read_rows, train
    from diffsim.learn.setup import Setup

    hover = Setup(
        "CopterHover",
        {"seconds": 0.2},
        steps=160,
        evaluate_every=40,
        evaluation_episodes=2,
        warm_up=5,
    )
    window = {"batch": 4, "window": 5, "critic_passes": 1}
    methods = {"gradient": {"batch": 4}, "shac": window, "sapo": window, "mixed": {"batch": 4}}
    found = {}
    for method, options in methods.items():
        learner = make_learner(method, hover, options)
        with TemporaryDirectory() as folder:
            train(hover, learner, Path(folder), show=False)
            rewards = [row["reward"] for row in read_rows(Path(folder))]
        weights = [p.detach().reshape(-1) for p in learner.controller().parameters()]
        found[method] = {"rewards": rewards, "weights": torch.cat(weights)}
    return found


ITEMS = {
    f.__name__: f
    for f in (
        application_search,
        device_search,
        recording_fit,
        demo_fit,
        trajectory_search,
        open_loop_search,
        training,
    )
}
