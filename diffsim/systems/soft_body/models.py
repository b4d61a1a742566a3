"""Ready soft-body models: a clamped bar let go, and a clamped bar pulled by a tendon."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffsim import mesh, soft
from diffsim.data.beam import BeamGeometry
from diffsim.identify import Parameter
from diffsim.identify.numerics import Numerics
from diffsim.systems.soft_body.clamped_beam import Beam, Setup
from diffsim.systems.soft_body.model import SoftModel
from diffsim.systems.soft_body.scene import SoftScene

if TYPE_CHECKING:
    from diffsim.data.study import Run

COARSE, FINE = (10, 2, 2), (20, 4, 4)

BEAM_BASE = (
    Parameter("youngs_modulus", 2.6e5, 0.3, "Pa", log=True),
    Parameter("rayleigh_beta", 2e-3, 0.7, "s", log=True),
)
TENDON_BASE = (*BEAM_BASE, Parameter("axial_stiffness", 40.0, 0.3, "N", log=True))


def release_nuisances(runs: Sequence[str], sd_s: float = 3e-3) -> tuple[Parameter, ...]:
    """When the hand let go, per run: nobody knows better than a third of a camera frame."""
    return tuple(Parameter(f"release_time@{run}", 0.0, sd_s, "s") for run in runs)


def beam_model(
    bar: BeamGeometry,
    *,
    runs: Sequence[str] = (),
    cells: tuple[int, int, int] = COARSE,
    dt_s: float = 4e-3,
    integrator: str = "bdf2",
    rtol: float = 1e-8,
    base: Sequence[Parameter] = BEAM_BASE,
) -> SoftModel:
    """The clamped silicone bar, straight and at rest until it is let go at t = 0.

    Channels: displacement of the mean tip marker from the held state, x, y, z [m]. A weight at the
    tip, ``setup["tip_load_mass_kg"]`` of a run, is a mass.

    Args:
        bar: Size and material of the bar.
        runs: Runs with a release time of their own as a nuisance.
        cells: Elements along, across and up: ``COARSE`` to screen, ``FINE`` to refit.
        dt_s: Time step of the simulation [s].
        integrator: Integrator of the body.
        rtol: Relative tolerance of every step's solution [-]; it limits the accuracy of
            differences.
        base: Parameters of ``body.physics`` and their priors.
    """
    nuisances = release_nuisances(runs)

    def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> SoftScene:
        setup = Setup(
            cells=finer(cells, numerics.mesh),
            integrator=integrator,
            dt_s=dt_s * numerics.time_step,
            weight_as="mass",
            rtol=rtol * numerics.tolerance,
        )
        beam = made(setup, float(run.setup.get("tip_load_mass_kg", 0.0)))
        face = torch.zeros(beam.mesh.num_nodes, dtype=torch.float64)
        face[beam.face] = 1.0 / len(beam.face)
        return SoftScene(
            body=beam.body,
            sample_times=torch.as_tensor(np.asarray(run.time_s), dtype=torch.float64),
            observe=beam.tip,
            axes=(0, 1, 2),
            parameters={p.name: values[p.name] for p in base},
            friction_shares=face,
            clock_offset=values.get(f"release_time@{run.name}", torch.zeros((), dtype=face.dtype)),
        )

    @lru_cache(maxsize=8)
    def made(setup: Setup, load_kg: float) -> Beam:
        return Beam(bar, setup, load_kg)

    return SoftModel(build, (*base, *nuisances), "clamped beam")


def tendon_model(
    *,
    size: tuple[float, float, float] = (0.1, 0.02, 0.02),
    density: float = 1070.0,
    poissons_ratio: float = 0.45,
    cells: tuple[int, int, int] = COARSE,
    dt_s: float = 4e-3,
    integrator: str = "bdf2",
    rtol: float = 1e-8,
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
    command: str = "shortening",
    water: bool = False,
    base: Sequence[Parameter] = TENDON_BASE,
) -> SoftModel:
    """A bar clamped at x = 0 with a tendon along it, a quarter of the height from the top.

    Channels: displacement of the tip's center from rest, x, y, z [m]. It starts in equilibrium
    under the run's first command.

    Args:
        size: Length, width and height of the bar [m].
        density: Density of the material [kg/m^3].
        poissons_ratio: Poisson's ratio of the material [-].
        cells, dt_s, integrator, rtol: Mesh, time step [s], integrator and tolerance as of
            :func:`beam_model`; an even number of cells up puts the tendon into element centers.
        gravity: Gravitational acceleration along x, y and z [m/s^2].
        command: Name of the run's command: share by which the tendon is shortened [-], evenly
            sampled.
        water: Water drags at the bar (its weight and inertia are for ``gravity`` and ``base`` to
            say).
        base: Base parameters: any that ``body.physics`` takes, and ``axial_stiffness`` of the
            tendon [N].
    """

    def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> SoftScene:
        body, observe, drag = made(
            finer(cells, numerics.mesh), dt_s * numerics.time_step, rtol * numerics.tolerance
        )
        given = {p.name: values[p.name] for p in base if p.name != "axial_stiffness"}
        if "axial_stiffness" in values:
            given["fiber_stiffness"] = values["axial_stiffness"][None]
        if command not in run.command:
            raise ValueError(
                f"run {run.name}: no command {command!r}, it has {sorted(run.command)}; name the "
                "tendon's column in tendon_model(command=...)"
            )
        pull = torch.as_tensor(np.asarray(run.command[command]), dtype=torch.float64)[:, None]
        times = torch.as_tensor(np.asarray(run.time_s), dtype=torch.float64)
        return SoftScene(
            body=body,
            sample_times=times - times[0],
            observe=observe,
            axes=(0, 1, 2),
            parameters=given,
            start="equilibrium",
            command=pull,
            command_dt=float(times[1] - times[0]),
            actuate=lambda shortening: 1.0 - shortening,
            water=drag,
        )

    @lru_cache(maxsize=8)
    def made(
        shape: tuple[int, int, int], dt: float, tolerance: float
    ) -> tuple[soft.SoftBody, Callable[[Tensor], Tensor], soft.Hydrodynamics | None]:
        bar = mesh.hex_box(shape, size)
        y, z = 0.5 * size[1], 0.75 * size[2]
        tendon = soft.Tendon(bar, [[0.0, y, z], [size[0], y, z]], axial_stiffness=40.0)
        body = soft.SoftBody(
            bar,
            dt=dt,
            integrator=integrator,
            youngs_modulus=2.6e5,
            poissons_ratio=poissons_ratio,
            density=density,
            gravity=gravity,
            fixed=bar.nodes_near_plane("x", 0.0),
            muscles=[tendon.muscle],
            solver=soft.SolverOptions(rtol=tolerance),
        )
        face = bar.nodes_near_plane("x", size[0])
        held = bar.x_rest[face].mean(0)
        drag = soft.Hydrodynamics(bar) if water else None
        return body, lambda x: x[..., face, :].mean(-2) - held, drag

    return SoftModel(build, tuple(base), "tendon-driven bar")


def finer(cells: tuple[int, int, int], factor: float) -> tuple[int, int, int]:
    """Numbers of cells whose size is ``factor`` times as large."""
    along, across, up = (max(1, round(n / factor)) for n in cells)
    return along, across, up
