"""A clamped bar that swings out, from a moment on when nothing touches it any more.

How it was let go does not matter then: the state at that moment is a nuisance of each run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffsim.data.beam import BeamGeometry
from diffsim.identify import Parameter
from diffsim.identify.numerics import Numerics
from diffsim.systems.soft_body.history import History
from diffsim.systems.soft_body.model import SoftModel
from diffsim.systems.soft_body.models import finer
from diffsim.systems.soft_body.released import SHARED, BeamTip, propping_force, tip_stiffness
from diffsim.systems.soft_body.scene import SoftScene

if TYPE_CHECKING:
    from diffsim.data.study import Channel, Run

SEEN = ("camera_pitch", "marker_ahead", "marker_above", "pitch_scale")
# A height alone says nothing of where exactly markers are and how cameras lie.
MATERIAL = tuple(p for p in SHARED if p.name not in SEEN)
SWING_SD_M = 2e-3
SMALL = 1e-3  # of the length, for what is linear
# Per run: what a hand that held the bar leaves open.
ZEROS = (
    Parameter("push", 0.0, 0.05, "m/s"),  # speed of the tip at the first sample
    Parameter("zero_z", 0.0, 1e-3, "m"),  # height of the held tip, from which others count
)


def swinging_beam(
    bar: BeamGeometry,
    channels: Sequence[Channel],
    swings_m: Mapping[str, float],
    *,
    cells: tuple[int, int, int] = (6, 2, 2),
    dt_s: float = 5e-3,
    integrator: str = "implicit_midpoint",
    poissons_ratio: float = 0.45,
    rtol: float = 1e-8,
    since_s: float | None = None,
    base: Sequence[Parameter] = MATERIAL,
) -> SoftModel:
    """The bar in free vibration from each run's first sample on.

    It starts in its lowest bending mode, as a static load like that mode's inertia bends it: higher
    modes have died out by then. The channel is the height of the tip over a held state that each
    run's zero corrects. A weight, ``setup["tip_load_mass_kg"]``, is a mass on the upper edge of the
    tip's face.

    Args:
        bar: Size and material of the bar.
        channels: Channels of the study, see
            :func:`diffsim.systems.soft_body.released.tip_channels`.
        swings_m: Height of the tip over its place at rest at each run's first sample, roughly, by
            name of the run [m].
        cells, dt_s, integrator, rtol: Numerics; implicit midpoint has no damping of its own.
        poissons_ratio: Hexahedra lock as it nears 0.5, bending hardly depends on it.
        since_s: First sample, after a hand that long held the bar straight let go [s]: what rubber
            that relaxes remembers. None: it remembers its first state only.
        base: Base parameters that all runs share.
    """
    own = tuple(
        Parameter(f"{p.name}@{run}", p.value, p.sd, p.unit)
        for run, swing_m in swings_m.items()
        for p in (Parameter("swing", float(swing_m), SWING_SD_M, "m"), *ZEROS)
    )

    def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> SoftScene:
        local = {n: values[f"{n}@{run.name}"] for n in ("swing", *(p.name for p in ZEROS))}
        tip, softness = made(
            finer(cells, numerics.mesh), dt_s * numerics.time_step, rtol * numerics.tolerance
        )
        slope = values["inclination"]
        gravity = bar.gravity_m_s2 * torch.stack(
            [slope.sin(), torch.zeros_like(slope), -slope.cos()]
        )
        load = float(run.setup.get("tip_load_mass_kg", 0.0)) * values["load_share"] * tip.edge
        mass = values["density"] * tip.body.nodal_volume + load
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        along = tip.body.x_rest[:, 0] / bar.length_m + 1.0
        shape = 0.5 * along**2 * (3.0 - along)  # of a tip load; the loads below refine it
        # Rayleigh: squared frequency of the lowest mode, with that shape
        young = values["youngs_modulus"]
        rate = tip_stiffness(bar, young) / (mass @ shape**2)
        prop = propping_force(bar, values["density"], tip, load)
        rest = tip.look(tip.body.x_rest)
        times = torch.as_tensor(np.asarray(run.time_s), dtype=torch.float64)
        return SoftScene(
            body=tip.body,
            sample_times=times - times[0],
            observe=tip.look,
            axes=tip.seen.axes,
            parameters={
                "youngs_modulus": young * softness,
                "rayleigh_beta": values["rayleigh_beta"],
                "density": values["density"],
                "gravity": gravity,
                "attached_mass": load,
            },
            start="equilibrium",
            holding_force=(local["swing"] * rate * mass * shape)[:, None] * up,
            start_velocity=local["push"] * shape[:, None] * up,
            history=None if since_s is None else History(since_s, prop, rate.sqrt()),
            friction_shares=tip.shares,
            output_maps=(lambda y, t: y - rest - local["zero_z"],),
        )

    @lru_cache(maxsize=8)
    def made(shape: tuple[int, int, int], dt: float, tolerance: float) -> tuple[BeamTip, float]:
        tip = BeamTip(bar, channels, shape, dt, tolerance, integrator, poissons_ratio)
        return tip, bending_softness(tip, bar, poissons_ratio)

    return SoftModel(build, (*base, *own), "swinging beam")


def bending_softness(tip: BeamTip, bar: BeamGeometry, poissons_ratio: float) -> float:
    """Tip displacement of the mesh over Timoshenko's, for a small tip load [-].

    Few cells bend too little (locking). The model's Young's modulus is multiplied by this, so that
    it means the same on every mesh and refining a mesh is no change of stiffness.

    Source: Timoshenko's cantilever with shear correction 10 (1 + nu) / (12 + 11 nu) (Cowper 1966).
    """
    young, nu = bar.youngs_modulus_published_Pa, poissons_ratio
    inertia = bar.width_m * bar.height_m**3 / 12.0
    shear = 10.0 * (1.0 + nu) / (12.0 + 11.0 * nu)
    per_force = bar.length_m**3 / (3.0 * young * inertia) + bar.length_m * 2.0 * (1.0 + nu) / (
        shear * young * bar.width_m * bar.height_m
    )
    force_N = SMALL * bar.length_m / per_force
    down = torch.tensor([0.0, 0.0, -force_N], dtype=torch.float64)
    none = torch.zeros(3, dtype=torch.float64)
    still = tip.body.static_equilibrium(
        external_force=tip.shares[:, None] * down,
        physics=tip.body.physics(
            youngs_modulus=torch.tensor(young, dtype=torch.float64), gravity=none
        ),
    )
    fallen = tip.shares @ (tip.body.x_rest - still.x.detach())[:, 2]
    return float(fallen) / (force_N * per_force)
