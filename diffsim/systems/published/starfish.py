"""The recorded starfish (``import_study("starfish")``): windows of it, model, causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim import soft
from diffsim.core.check import require_choice
from diffsim.data.importers.starfish import COMMAND
from diffsim.data.study import Run, Study
from diffsim.identify import Jacobian, Parameter
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.model import Numerics
from diffsim.identify.setup import DiagnosisSetup
from diffsim.identify.unknown import UnknownForce, smooth_covariance
from diffsim.systems.soft_body import SoftModel, SoftScene
from diffsim.systems.soft_body.material import LOSS_FACTOR, STIFFENING
from diffsim.systems.starfish.body import LEAD, TENDON, Quarter, bending_softness, quarter, water
from diffsim.systems.starfish.effects import STARFISH_EFFECTS, unknown_pull, unknown_push
from diffsim.systems.starfish.record import AS_IMPORTED, FIRST, LEGS, MODES, modes

# How much later than 0.2 s before the command a window begins [s].
WINDOWS = {
    "water": {"baseline": 0.0, "horizontal_cyclic3": 0.0, "horizontal_cyclic1": 0.0},
    "air": {"airtest": 0.0, "airtest+10": 10.0, "airtest+20": 20.0},
}
HELD_OUT = ("horizontal_cyclic1", "airtest+20")
KNOTS_PER_S = 6.0
RTOL = 1e-9  # of steps: differences over DIFFERENCE amplify what is left
DIFFERENCE = 1e-4  # prior sd
SHARED = (
    Parameter("youngs_modulus", 6e5, 0.4, "Pa", log=True),
    Parameter("axial_stiffness", 300.0, 0.7, "N", log=True),  # EA of a tendon
    Parameter("rayleigh_beta", 5e-3, 0.7, "s", log=True),
    Parameter("density", 800.0, 0.3, "kg/m^3", log=True),  # foam 400, ballasted to at most 1000
)
IN_WATER = (
    Parameter("drag_scale", 1.0, 0.5, "-", log=True),  # on the published coefficients
    Parameter("thrust_scale", 1.0, 0.5, "-", log=True),
    Parameter("added_mass", 1.0, 0.4, "-", log=True),
)
OF_RUN = (
    Parameter("clock_offset", 0.0, 0.05, "s"),  # up to about 0.1 s, README
    Parameter("clock_rate", 1.0, 0.003, "-", log=True),  # of the command's clock: 0.36 % seen once
    Parameter("camera_scale", 1.0, 0.03, "-", log=True),
    Parameter("zero_leg_x", 0.0, 3e-4, "m"),
    Parameter("zero_leg_z", 0.0, 3e-4, "m"),
    Parameter("zero_travel_x", 0.0, 3e-4, "m"),
)


def setup(
    study: Study,
    *,
    medium: str = "water",
    channels: Sequence[str] = LEGS,
    sd_m: float | None = None,
    window_s: float = 1.6,
    refine: int = 1,
    dt_s: float = 1.0 / 180.0,
    integrator: str = "bdf2",
    poissons_ratio: float = 0.4,
    max_effects: int = 2,
    accept_numerics: bool = False,
) -> DiagnosisSetup:
    """A quarter of the robot as the thesis models it, and what may be missing.

    Args:
        study: Study as imported, or windows of it that :func:`modes` made.
        medium: "water" or "air": which ``WINDOWS`` of a study as imported.
        channels: Names of the channels, out of ``MODES``; for a study as imported.
        sd_m: Noise that differences between repeats are compared with, as in :func:`modes`, for a
            study as imported [m].
        window_s: Length of the windows that are cut from the runs [s].
        refine: Cells per coarse cell's edge.
        dt_s: Time step of the simulation [s].
        integrator: Integrator of the body.
        poissons_ratio: 0.4 in the authors' code, 0.48 in the thesis.
        max_effects: Largest number of effects in one set.
        accept_numerics: Go on although step or mesh move the record.

    Raises:
        ValueError: a channel that is none of ``MODES``.
    """
    require_choice("medium", medium, tuple(WINDOWS))
    if {c.name for c in study.channels} == AS_IMPORTED:
        windows = {name: (later, window_s) for name, later in WINDOWS[medium].items()}
        held = [name for name in windows if name in HELD_OUT]
        study = modes(study, windows=windows, holdout=held, channels=channels, sd_m=sd_m)
    if strange := {c.name for c in study.channels} - set(MODES):
        raise ValueError(
            f"study {study.name}: channels must be of {MODES}, or all places of the markers as "
            f"imported, got {sorted(strange)}"
        )
    wet = study.metadata.get("medium") == "water"
    options = (refine, dt_s, integrator, poissons_ratio)
    model = _model([c.name for c in study.channels], [r.name for r in study.runs], wet, options)
    effects = (*STARFISH_EFFECTS, LOSS_FACTOR, STIFFENING)
    until_s = LEAD + max(float(r.time_s[-1]) for r in study.runs)
    settings = DiagnosisSettings(
        search=SearchSettings(max_effects=max_effects, num_refits=2, max_rounds=4),
        # a larger step sees tendons go slack and taut again
        jacobian=Jacobian(step=DIFFERENCE),
        accept_numerics=accept_numerics,
        noise_rounds=1,
    )
    return DiagnosisSetup(
        model, effects, unknowns=_unknowns(until_s), settings=settings, study=study
    )


def _model(
    channels: Sequence[str], runs: Sequence[str], wet: bool, options: tuple[Any, ...]
) -> SoftModel:
    shown = [MODES.index(c) for c in channels]
    refine, dt_s, integrator, poissons_ratio = options
    own = [p for p in OF_RUN if p.name != "zero_travel_x" or "travel_x_m" in channels]
    base = (*SHARED, *(IN_WATER if wet else ()))
    of_runs = [Parameter(f"{p.name}@{r}", p.value, p.sd, p.unit, p.log) for r in runs for p in own]

    @lru_cache(maxsize=8)
    def body(refined: int, dt: float, tolerance: float) -> tuple[Quarter, float]:
        made = quarter(refined, dt, tolerance, integrator, poissons_ratio)
        return made, bending_softness(made)

    @lru_cache(maxsize=256)
    def cached_water(made: Quarter, drag: float, thrust: float) -> soft.Hydrodynamics:
        return water(made.body.mesh, torch.tensor(drag).double(), torch.tensor(thrust).double())

    def around(made: Quarter, drag: Tensor, thrust: Tensor) -> soft.Hydrodynamics:
        # one object for one pair of values, so that tangents know scenes in equal water
        if drag.requires_grad or thrust.requires_grad:
            return water(made.body.mesh, drag, thrust)
        return cached_water(made, float(drag), float(thrust))

    def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> SoftScene:
        made, softness = body(
            max(1, round(refine / numerics.mesh)),
            dt_s * numerics.time_step,
            RTOL * numerics.tolerance,
        )
        mine = {p.name: values[f"{p.name}@{run.name}"] for p in own}
        zero = torch.stack([mine.get(f"zero_{c[:-2]}", torch.tensor(0.0)) for c in MODES])
        zero = zero.double()
        parameters = {n: values[n] for n in ("rayleigh_beta", "density")}
        parameters["youngs_modulus"] = softness * values["youngs_modulus"]
        # half a tendon in a quarter of the body
        parameters["fiber_stiffness"] = (0.5 * values["axial_stiffness"]).expand(2)
        around_it = None
        if wet:
            around_it = around(made, values["drag_scale"], values["thrust_scale"])
            volume = made.body.nodal_volume
            parameters["added_mass"] = values["added_mass"] * 1000.0 * volume
        rate = mine["clock_rate"]
        command, lead_s = led_in(np.asarray(run.command[COMMAND]) / TENDON, run.time_s)
        return SoftScene(
            body=made.body,
            sample_times=lead_s + rate * torch.as_tensor(run.time_s - run.time_s[0]),
            observe=made.look,
            axes=(0, 2, 0),
            parameters=parameters,
            command=torch.from_numpy(command)[:, None],
            command_dt=float(np.median(np.diff(run.time_s))),
            actuate=_shortened,
            water=around_it,
            friction_shares=made.rail,
            clock_offset=mine["clock_offset"],
            output_maps=(
                lambda y, t: (mine["camera_scale"] * (y - y[:FIRST].mean(0)) + zero)[:, shown],
            ),
        )

    return SoftModel(build, (*base, *of_runs), "quarter of the starfish")


def led_in(
    command: NDArray[np.float64], time_s: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """The command with a ramp from zero and a rest before it, and how long these last [s].

    A robot that is free along x has no equilibrium to start from, and slack depends on the past.
    """
    dt = float(np.median(np.diff(time_s)))
    count = round(LEAD / dt)
    ramp = np.clip(np.arange(count) * dt / (0.5 * LEAD), 0.0, 1.0)
    return np.concatenate([ramp * command[0], command]), count * dt


def _shortened(contraction: Tensor) -> Tensor:
    """Activation of both tendons: length over full length."""
    return (1.0 - contraction).expand(2)


def _unknowns(until_s: float) -> tuple[UnknownForce, ...]:
    """Hydrodynamics or actuation without a form: a force along x, a pull of the tendons."""
    count = max(4, round(KNOTS_PER_S * until_s) + 1)
    knots = np.linspace(0.0, until_s, count)
    spacing = until_s / (count - 1)
    in_time = smooth_covariance(knots, 2.0 * spacing)
    both = np.kron(np.eye(2), in_time).astype(np.float64)
    return (
        UnknownForce(unknown_push(count, spacing), both),
        UnknownForce(unknown_pull(count, spacing), in_time, "unknown pull of the tendons"),
    )


__all__ = ["WINDOWS", "modes", "setup"]
