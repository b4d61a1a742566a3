"""The virtual laboratory's beam (``SoftBeamLab``): a tendon bends a clamped bar sideways."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from diffsim.data.study import Run, Study
from diffsim.identify import Parameter
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.numerics import Numerics
from diffsim.identify.setup import DiagnosisSetup
from diffsim.identify.unknown import UnknownForce, smooth_covariance
from diffsim.systems.soft_body.model import SoftModel
from diffsim.systems.soft_body.scene import SoftScene
from diffsim.systems.soft_body.unknown import unknown_force
from labs.systems.beam_bar import BarShape, TendonBar
from labs.systems.beam_causes import causes

KNOTS_PER_S = 5.0
# Causes act almost in proportion to their sizes here (docs/measured/lab_beam.md): linear evidence
# is wrong by less than elsewhere, and most sets need no refit.
EFFORT = SearchSettings(
    max_effects=2, num_refits=2, max_rounds=3, rival_nats=4.0, linear_error=0.02, unknown_steps=2
)


def setup(
    study: Study,
    *,
    cells: Sequence[int] = (10, 2, 1),
    dt_s: float = 1e-2,
    search: SearchSettings | None = None,
    accept_numerics: bool = False,
) -> DiagnosisSetup:
    """The laboratory's bar as a solid.

    Args:
        study: Study made by ``SoftBeamLab``.
        cells: Elements along, in the plane of bending and across; an even number in the plane.
        dt_s: Time step [s]; the samples' 10 ms must be a multiple.
        search: Effort of the search; None: the default for this system.
        accept_numerics: Go on although time step or mesh move the record by more than the noise.
    """
    along, plane, across = (int(n) for n in cells)
    model = lab_beam(study, cells=(along, plane, across), dt_s=float(dt_s))
    until_s = max(float(run.time_s[-1]) for run in study.runs)
    count = round(KNOTS_PER_S * until_s) + 1
    knots = np.linspace(0.0, until_s, count)
    force = unknown_force(count, until_s, axes="y")
    in_time = smooth_covariance(knots, 2.0 * until_s / (count - 1))
    return DiagnosisSetup(
        model,
        causes(float(study.metadata["tendon"]["max_tension_N"])),
        unknowns=(UnknownForce(force, np.kron(np.eye(2), in_time).astype(np.float64)),),
        bank=_bank(study),
        settings=DiagnosisSettings(
            search=search or EFFORT,
            accept_numerics=accept_numerics,
            noise_rounds=1,
        ),
    )


def lab_beam(
    study: Study, *, cells: tuple[int, int, int], dt_s: float, rtol: float = 1e-9
) -> SoftModel:
    """A described bar clamped at x = 0 with a pair of rods that give the laboratory's moment.

    Young's modulus and density are multiplied by what this mesh and time step are known to miss
    (:class:`TendonBar`), so that they mean the same on every mesh.
    """
    facts = {name: study.metadata[name] for name in ("geometry", "tendon", "markers")}
    young, beta = (study.metadata["base_priors"][n] for n in ("youngs_modulus", "rayleigh_beta"))
    dimensions = {n: float(v) for n, v in facts["geometry"].items() if n != "num_cells"}
    shape = BarShape(**dimensions, youngs_modulus=float(young["value"]))
    places = {name: float(x) for name, x in facts["markers"]["place_m"].items()}
    arm = float(facts["tendon"]["offset_m"])

    base = [
        Parameter("youngs_modulus", young["value"], young["relative_sd"], "Pa", log=True),
        Parameter("rayleigh_beta", beta["value"], beta["relative_sd"], "s", log=True),
    ]
    place_sd, zero_sd = facts["markers"]["place_sd_m"], facts["markers"]["zero_sd_m"]
    base += [Parameter(f"place_{name}", 0.0, float(place_sd), "m") for name in places]
    runs = [run.name for run in study.runs] + [run.name for run in _bank(study)]
    jitter = float(study.metadata["gain_jitter"])
    base += [Parameter(f"gain@{run}", 1.0, jitter, "-") for run in runs]
    base += [Parameter(f"zero_{n}@{run}", 0.0, float(zero_sd), "m") for n in places for run in runs]

    @lru_cache(maxsize=8)
    def made(count: tuple[int, int, int], dt: float, tolerance: float) -> TendonBar:
        return TendonBar(shape, count, arm, "tendon_N", dt, tolerance)

    def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> SoftScene:
        count = finer(cells, numerics.mesh)
        bar = made(count, dt_s * numerics.time_step, rtol * numerics.tolerance)
        gain = values[f"gain@{run.name}"]
        moved = torch.stack([x + values[f"place_{name}"] for name, x in places.items()])
        zeros = torch.stack([values[f"zero_{name}@{run.name}"] for name in places])
        scene = bar.scene(values["youngs_modulus"], values["rayleigh_beta"], run)
        rods = scene.actuate
        assert rods is not None
        return scene.changed(
            axes=(1,) * len(places),
            actuate=lambda tension: rods(gain * tension),
            output_maps=(lambda y, t: bar.sideways(y, moved) + zeros,),
        )

    return SoftModel(build, base, "tendon-driven bar of the laboratory")


def _bank(study: Study) -> tuple[Run, ...]:
    """Tensions that could be commanded: a quarter, half and all of the drive, slow and fast."""
    like = study.fit_runs[0]
    t = np.asarray(like.time_s) - like.time_s[0]
    released = np.clip(np.minimum(t / 0.3, (0.6 - t) / 0.1), 0.0, 1.0)
    commands = {
        "release_low": 0.4 * released,
        "release_high": 1.6 * released,
        "sine_2Hz_low": 0.3 * (1.0 - np.cos(2 * np.pi * 2.0 * t)) / 2.0,
        "sine_2Hz_high": 1.5 * (1.0 - np.cos(2 * np.pi * 2.0 * t)) / 2.0,
        "sine_5Hz": 0.8 * (1.0 - np.cos(2 * np.pi * 5.0 * t)) / 2.0,
        "sine_8Hz": 1.5 * (1.0 - np.cos(2 * np.pi * 8.0 * t)) / 2.0,
    }
    empty = np.zeros_like(like.measured)
    return tuple(
        replace(like, name=f"bank_{name}", group=name, command={"tendon_N": u}, measured=empty)
        for name, u in commands.items()
    )


def finer(cells: tuple[int, int, int], factor: float) -> tuple[int, int, int]:
    """Numbers of cells whose size is ``factor`` times as large."""
    along, across, up = (max(1, round(n / factor)) for n in cells)
    return along, across, up
