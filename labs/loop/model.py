"""The simulated starfish of thesis 5.2: a quarter of it, with the parameters of Table 5.1."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim import soft
from diffsim.causes.scene import Commands, grid_at
from diffsim.data.study import Channel, Run, Study
from diffsim.identify import Parameter
from diffsim.identify.effect import Effect, effect_coordinates
from diffsim.identify.model_file import SavedModel
from diffsim.identify.numerics import Numerics
from diffsim.mesh import HexMesh, TetMesh
from diffsim.soft.hydrodynamics import DRAG_COEFFICIENTS, THRUST_COEFFICIENTS
from diffsim.systems.soft_body import SoftModel, SoftScene
from diffsim.systems.twin import PLANNED, Twin
from labs.loop.body import LEAD, TENDON, Quarter, quarter, water
from labs.loop.command import RATE_HZ
from labs.loop.recordings import COMMAND, MARKERS

Array = NDArray[np.float64]
CHANNELS = tuple(f"{marker}_{axis}_m" for marker in MARKERS for axis in "xz")
PLACES_M = (-0.070, -0.040, 0.0362, 0.0632)  # of the markers along z (README of the recordings)
FIRST = 6  # samples that displacements are counted from
MAX_FORCE_N = 0.5  # of water on a node; swimming makes hundredths
_ONE = torch.ones((), dtype=torch.float64)


def _compute_activation(contraction: Tensor) -> Tensor:
    """Activation of both tendons: length over full length."""
    return (1.0 - contraction / TENDON).expand(*contraction.shape[:-1], 2)


def table_5_1() -> tuple[Parameter, ...]:
    """Trainable parameters with priors about the thesis's first guesses (Table 5.1).

    E in [Pa]; w as the axial stiffness EA of one tendon [N], for which 300 N is the guess; four
    control points each of C_d and C_t. C_d is not negative; the bounds of C_t keep explicit drag
    stable.
    """
    stiff = (
        Parameter("youngs_modulus", 9e5, 0.7, "Pa", log=True, lower=1e5, upper=5e6),
        Parameter("axial_stiffness", 300.0, 0.7, "N", log=True, lower=20.0, upper=5e3),
    )
    drag = [
        Parameter(f"drag_{i}", c, 0.5, lower=0.0, upper=5.0)
        for i, c in enumerate(DRAG_COEFFICIENTS, 1)
    ]
    thrust = [
        Parameter(f"thrust_{i}", c, 0.5, lower=-4.0, upper=4.0)
        for i, c in enumerate(THRUST_COEFFICIENTS, 1)
    ]
    return (*stiff, *drag, *thrust)


@dataclass(frozen=True, eq=False, kw_only=True)
class Starfish:
    """What a simulation of the robot is made of, beside its trainable parameters.

    Attributes:
        parameters: Trainable, shared by all runs.
        dt_s: Time step; 1/60 s in thesis 5.2.1.
        refine: Cells per coarse cell's edge.
        poissons_ratio: 0.48 in the thesis, 0.4 in the authors' code.
        rayleigh_beta: Damping of the foam, held fixed [s].
        added_mass: Inertia of the water, in volumes of the body, held fixed [-].
        clock_sd_s: Prior of the offset between the clocks of command and camera [s].
        rtol: Tolerance of a step.
        causes: What a diagnosis found between command and body, or in it, as ``extended`` sets it;
            sizes are among ``parameters``, by name.
        command: What their study calls the contraction.
    """

    parameters: tuple[Parameter, ...] = field(default_factory=table_5_1)
    dt_s: float = 1.0 / 60.0
    refine: int = 1
    poissons_ratio: float = 0.4
    rayleigh_beta: float = 5e-3
    added_mass: float = 1.0
    clock_sd_s: float = 0.05
    rtol: float = 1e-4
    causes: tuple[Effect, ...] = ()
    command: str = COMMAND

    def extended(self, path: str | Path | SavedModel, study: str | Path | Study) -> Starfish:
        """The robot with the causes of an ``extended_model.yaml``.

        Their sizes become parameters, with the file's posterior as prior: a later identification
        goes on from there. Causes in the recording's instruments are left out, as are parameters
        of the study's own body.

        Args:
            path: The file, or the folder that holds it, or its content.
            study: Study that it was fitted to, or its file; of a soft body with one command, the
                contraction of the tendons [m].

        Raises:
            FileNotFoundError: no such file.
            ValueError: a study of another system, or of several commands.
        """
        twin = Twin.read(path, study, np.arange(2) / RATE_HZ)
        kind, names = (twin.study.model or {}).get("system"), list(twin.run.command)
        if kind != "soft_body" or len(names) != 1:
            raise ValueError(
                f"study {twin.study.name}: a {kind} with the commands {names}; the starfish takes "
                "causes of a soft_body whose only command is the contraction of its tendons"
            )
        causes = tuple(e for e in twin.model.effects if e.kind != "sensor")
        sizes = {p.name: p for p in twin.model.base}
        known = {p.name for p in self.parameters}
        more = [sizes[name] for name in effect_coordinates(causes) if name not in known]
        parameters = (*self.parameters, *more)
        return replace(self, parameters=parameters, causes=causes, command=names[0])

    def mended(
        self, values: Mapping[str, float], share: float, causes: Collection[str] = ()
    ) -> dict[str, float]:
        """Values with which causes act with a share of their sizes; 0: mended.

        Args:
            values: Values of ``parameters``, by name.
            share: Factor on the sizes.
            causes: Names of causes; empty: all.
        """
        mine = [e for e in self.causes if not causes or e.name in causes]
        sizes = effect_coordinates(mine)
        return {n: share * v if n in sizes else v for n, v in values.items()}

    def draw(
        self, values: Mapping[str, float], saved: SavedModel, count: int, rng: np.random.Generator
    ) -> list[dict[str, float]]:
        """Values whose sizes of causes are drawn from what the data of a diagnosis allow.

        Args:
            values: Values of ``parameters``, by name; those of the body stay.
            saved: Content of the file that the causes are of.
            count: Number of draws.
            rng: Source of chance.
        """
        names = effect_coordinates(self.causes)
        drawn = saved.draw(names, count, rng).tolist()
        return [dict(values) | dict(zip(names, row, strict=True)) for row in drawn]

    @cached_property
    def quarter(self) -> Quarter:
        """The body, made once."""
        return quarter(self.refine, self.dt_s, self.rtol, "implicit_euler", self.poissons_ratio)

    @cached_property
    def _rows(self) -> tuple[Tensor, Tensor]:
        """Weights (4, n) of the edge's nodes, one row per marker, and the sides of the markers."""
        made = self.quarter
        along = made.body.x_rest[made.nodes, 2].numpy()
        rows = [[np.interp(abs(z), along, unit) for unit in np.eye(len(along))] for z in PLACES_M]
        return torch.tensor(rows, dtype=torch.float64), torch.tensor(PLACES_M).sign().double()

    def observe(self, x: Tensor) -> Tensor:
        """Places of the markers and of the center of mass.

        Args:
            x: (..., num_nodes, 3) [m].

        Returns:
            (..., 9): x and z of four markers, and x of the center of mass (thesis eq. 5.11; by
            volume, not by vertex) [m].
        """
        made = self.quarter
        rows, side = self._rows
        places = rows @ x[..., made.nodes, :]
        volume = made.body.nodal_volume
        center = (volume * x[..., 0]).sum(-1, keepdim=True) / volume.sum()
        seen = torch.stack([places[..., 0], side * places[..., 2]], -1).flatten(-2)
        return torch.cat([seen, center], -1)

    def scene(
        self,
        values: Mapping[str, Tensor],
        contraction: Tensor,
        times: Tensor,
        clock_offset: Tensor | None = None,
    ) -> SoftScene:
        """One run: tendons are tightened to the first value, and held, before the record begins.

        Args:
            values: Values of ``parameters``, by name, sizes of causes among them.
            contraction: Commanded at ``times``, (n,) [m]. Carries gradients.
            times: Evenly spaced from 0, (n,) [s]; when ``observe`` is asked for.
            clock_offset: The record's clock is late by this, () [s].
        """
        made = self.quarter
        dt = float(times[1] - times[0])
        count = round(LEAD / dt)
        ramp = torch.clamp(torch.arange(count, dtype=torch.float64) * dt / (0.5 * LEAD), max=1.0)
        drag, thrust = (
            torch.stack([values[f"{name}_{i}"] for i in range(1, 5)]) for name in ("drag", "thrust")
        )
        volume = made.body.nodal_volume
        scene = SoftScene(
            body=made.body,
            grid=grid_at((times + count * dt).detach()),
            observe=self.observe,
            axes=(0, 2) * len(MARKERS) + (0,),
            numbers={
                "youngs_modulus": values["youngs_modulus"],
                # half a tendon in a quarter of the body
                "fiber_stiffness": (0.5 * values["axial_stiffness"]).expand(2),
                "rayleigh_beta": torch.tensor(self.rayleigh_beta, dtype=torch.float64),
                "added_mass": 1000.0 * self.added_mass * volume,
            },
            commands=Commands.named(
                (self.command,), torch.cat([ramp * contraction[0], contraction])[None]
            ),
            command_dt=dt,
            actuate=_compute_activation,
            water=water_of(made.body.mesh, drag, thrust),
            clock_offset=torch.zeros((), dtype=torch.float64)
            if clock_offset is None
            else clock_offset,
        )
        return self._with_causes(scene, values, times)

    def _with_causes(
        self, scene: SoftScene, values: Mapping[str, Tensor], times: Tensor
    ) -> SoftScene:
        """The scene with the diagnosed causes at their sizes."""
        if not self.causes:
            return scene
        seconds = times.numpy()
        none = np.full((len(seconds), len(CHANNELS)), np.nan)
        run = Run(PLANNED, seconds, none, {COMMAND: np.zeros(len(seconds))}, PLANNED)
        for effect in self.causes:
            size = torch.stack([values[c] for c in effect_coordinates([effect])], -1)
            scene = effect.act(scene, size, run, values)
        return scene

    def motion(self, values: Mapping[str, float | Tensor], contraction: Tensor) -> Tensor:
        """What ``observe`` says of a command at ``RATE_HZ``, (num_samples, 9) [m].

        Args:
            values: Values of ``parameters``, by name.
            contraction: (num_samples,) [m]. Gradients: contraction, values.
        """
        tensors = {n: torch.as_tensor(v, dtype=torch.float64) for n, v in values.items()}
        times = torch.arange(len(contraction), dtype=torch.float64) / RATE_HZ
        return self.scene(tensors, contraction, times).simulate()

    def fit_model(self, runs: Sequence[str]) -> SoftModel:
        """For :func:`diffsim.identify.fit`: markers' displacements from the first 0.1 s.

        Args:
            runs: Names of the runs, each with a clock of its own.
        """
        clocks = [
            Parameter(f"clock_offset@{r}", 0.0, self.clock_sd_s, "s", lower=-0.2, upper=0.2)
            for r in runs
        ]

        def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> SoftScene:
            contraction = torch.from_numpy(np.ascontiguousarray(run.command[COMMAND]))
            times = torch.from_numpy(run.time_s - run.time_s[0])
            scene = self.scene(values, contraction, times, values[f"clock_offset@{run.name}"])
            return scene.changed(
                output_maps=(lambda y, times: displacements(y)[:, : len(CHANNELS)],)
            )

        return SoftModel(build, (*self.parameters, *clocks), "starfish, thesis 5.2")


def displacements(observed: Tensor) -> Tensor:
    """Places (n, ...) from their mean over the first samples [m]."""
    return observed - observed[:FIRST].mean(0)


def as_displacements(run: Run, duration_s: float, sd_m: float) -> tuple[Run, tuple[Channel, ...]]:
    """The beginning of a recording as the fit sees it.

    Places of the camera's origin and of the markers drop out of displacements from the first 0.1 s.

    Args:
        run: With ``CHANNELS`` and the executed contraction.
        duration_s: What is kept, from the first sample on [s].
        sd_m: What a single sample is trusted to, noise and model together [m].

    Raises:
        ValueError: wrong channels, a hole in the command, or no marker seen at the start.
    """
    if COMMAND not in run.command or run.measured.shape[1:] != (len(CHANNELS),):
        raise ValueError(
            f"run {run.name} must have the channels {CHANNELS} and the command {COMMAND}, got "
            f"{run.measured.shape[1]} channels and {sorted(run.command)}"
        )
    kept = run.time_s - run.time_s[0] < duration_s - 1e-9
    start = run.measured[:FIRST]
    if not np.isfinite(start).any(0).all():
        raise ValueError(f"run {run.name}: a marker is not seen in the first {FIRST} samples")
    command = run.command[COMMAND][kept]
    if not np.isfinite(command).all():
        raise ValueError(f"run {run.name}: {COMMAND} has holes in the first {duration_s:g} s")
    moved = run.measured[kept] - np.nanmean(start, axis=0)
    cut = replace(run.part(kept), measured=moved, command={COMMAND: command})
    return cut, tuple(Channel(c, "m", "position", sd_m) for c in CHANNELS)


def water_of(mesh: HexMesh | TetMesh, drag: Tensor, thrust: Tensor) -> soft.Hydrodynamics:
    """Water around the quarter with these control points, (4,) each."""
    found = water(mesh, _ONE, _ONE)
    found.register_buffer("drag_coefficients", drag)
    found.register_buffer("thrust_coefficients", thrust)
    # a solver's trial may be unstable with explicit drag: then the misfit is large, not infinite
    found.max_force, found.warn = MAX_FORCE_N, False
    return found
