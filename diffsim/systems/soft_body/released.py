"""A clamped bar, held by a hand at its tip and let go: what a recording of it needs to be compared.

What nobody knows exactly is a base parameter: when, how high and how fast the hand let go, how the
cameras' axes lie, where the markers are, how heavy weight and rubber are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffsim import mesh, soft
from diffsim.data.beam import TIP_MARKERS, BeamGeometry
from diffsim.identify import Parameter
from diffsim.identify.numerics import Numerics
from diffsim.systems.soft_body.markers import marker_weights
from diffsim.systems.soft_body.model import SoftModel
from diffsim.systems.soft_body.models import finer
from diffsim.systems.soft_body.scene import SoftScene

if TYPE_CHECKING:
    from diffsim.data.study import Channel, Run

SHARED = (
    Parameter("youngs_modulus", 2.2e5, 0.3, "Pa", log=True),
    Parameter("rayleigh_beta", 2e-3, 0.7, "s", log=True),
    Parameter("density", 1070.0, 0.01, "kg/m^3", log=True),  # of the data sheet
    Parameter("load_share", 1.0, 0.02, "-", log=True),  # hook and string weigh something
    Parameter("inclination", 0.0, 0.05, "rad"),  # of gravity against the bar's cross-section
    Parameter("camera_pitch", 0.0, 0.02, "rad"),  # markers alone ask for 4.7 to 8.2 degrees
    Parameter("marker_ahead", 0.0, 2e-3, "m"),  # stubs; nominal places fit to 0.3-2 mm
    Parameter("marker_above", 0.0, 1e-3, "m"),
    # by the nominal places the markers turn 8 % less than by their measured ones
    Parameter("pitch_scale", 1.0, 0.08, "-", log=True),
)
# Per run: the hand.
HAND = (
    Parameter("release_time", 0.0, 5e-3, "s"),  # half a camera frame
    Parameter("held_above", 0.0, 7e-4, "m"),  # the tip, over where the unstrained bar has it
    Parameter("push", 0.0, 0.02, "m/s"),  # speed of the tip when it is let go
    Parameter("zero_x", 0.0, 3e-5, "m"),  # the hand trembles while the held place is taken
    Parameter("zero_z", 0.0, 5e-5, "m"),
    Parameter("zero_pitch", 0.0, 5e-4, "rad"),
)


@dataclass(frozen=True)
class TipChannels:
    """Channels that show the tip's face, all linear in its nodes.

    Attributes:
        weights: (num_channels, num_face_nodes) of the places along the channel's axis.
        axes: (num_channels,) 0, 1, 2 for x, y, z.
        pitch: (num_channels,) of the rotation about y [rad] in the channels; small angles.
        partner: (num_channels,) the channel of the same markers along x for one along z and the
            reverse, and the sign with which a camera's pitch mixes it in; (0, 0.0) where none.
        lever: (num_channels, 2) change per rotation, for markers further ahead and above.
    """

    weights: Tensor
    axes: tuple[int, ...]
    pitch: Tensor
    partner: tuple[tuple[int, float], ...]
    lever: Tensor


def pitch_weights(bar: BeamGeometry) -> np.ndarray:
    """(num_markers,) with pitch = weights @ x displacements of the tip's markers [1/m]."""
    height = np.array([bar.marker_place_m[name][2] for name in TIP_MARKERS])
    height = height - height.mean()
    return np.asarray(height / (height @ height))


def tip_channels(bar: BeamGeometry, face: np.ndarray, channels: Sequence[Channel]) -> TipChannels:
    """Reads ``tip1_x_m`` (a marker), ``tip_x_m`` (mean of all) and ``tip_pitch_rad``.

    Args:
        bar: Bar with the nominal places of its markers.
        face: (n, 3) rest places of the tip face's nodes [m].
        channels: Channels of the study.

    Raises:
        ValueError: a channel of another name.
    """
    places = np.array([bar.marker_place_m[name] for name in TIP_MARKERS])
    rows = dict(zip(TIP_MARKERS, marker_weights(face, places), strict=True))
    turn = pitch_weights(bar)
    rows["tip"] = np.mean([rows[name] for name in TIP_MARKERS], axis=0)
    pitch_row = sum(w * rows[name] for w, name in zip(turn, TIP_MARKERS, strict=True))
    names = [c.name for c in channels]
    weights, axes, lever, partner = [], [], [], []
    for name in names:
        marker, _, rest = name.partition("_")
        axis = "xyz".find(rest[:1]) if rest.endswith("_m") else 0
        if name == "tip_pitch_rad":
            weights.append(pitch_row)
            lever.append((0.0, 0.0))
        elif marker in rows and axis >= 0:
            weights.append(rows[marker])
            lever.append(((0.0, 1.0), (0.0, 0.0), (-1.0, 0.0))[axis])
        else:
            raise ValueError(
                f"channel {name!r} is not one of tip_x_m, tip1_x_m (.. y, z) or tip_pitch_rad"
            )
        axes.append(axis)
        other = {"x_m": ("z_m", 1.0), "z_m": ("x_m", -1.0)}.get(rest)
        twin = f"{marker}_{other[0]}" if other else ""
        partner.append((names.index(twin), other[1]) if other and twin in names else (0, 0.0))
    if "tip_pitch_rad" in names:
        pitch = np.eye(len(names))[names.index("tip_pitch_rad")]
    else:
        own = {f"{m}_x_m": w for m, w in zip(TIP_MARKERS, turn, strict=True)}
        pitch = np.array([own.get(name, 0.0) if set(own) <= set(names) else 0.0 for name in names])
    return TipChannels(
        torch.from_numpy(np.array(weights)),
        tuple(axes),
        torch.from_numpy(pitch),
        tuple(partner),
        torch.tensor(lever, dtype=torch.float64),
    )


def released_beam(
    bar: BeamGeometry,
    channels: Sequence[Channel],
    runs: Sequence[str],
    *,
    cells: tuple[int, int, int] = (6, 1, 2),
    dt_s: float = 4e-3,
    integrator: str = "implicit_midpoint",
    poissons_ratio: float = 0.45,
    rtol: float = 1e-8,
    base: Sequence[Parameter] = SHARED,
) -> SoftModel:
    """The bar, propped by a hand under its tip until t = 0, then free.

    Channels are displacements from each run's first sample, which must be recorded before release.
    A weight, ``setup["tip_load_mass_kg"]``, is a mass on the upper edge of the tip's face.

    Args:
        bar: Size and material of the bar.
        channels: Channels of the study, as :func:`tip_channels` reads them.
        runs: Names of all runs of the study: the hand's part is each run's own.
        cells, dt_s, integrator, rtol: Numerics; implicit midpoint has no damping of its own.
        poissons_ratio: Hexahedra lock as it nears 0.5, bending hardly depends on it.
        base: Base parameters that all runs share.
    """
    own = tuple(
        Parameter(f"{p.name}@{run}", p.value, p.sd, p.unit, p.log) for run in runs for p in HAND
    )

    def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> SoftScene:
        hand = {p.name: values[f"{p.name}@{run.name}"] for p in HAND}
        tip = made(
            finer(cells, numerics.mesh), dt_s * numerics.time_step, rtol * numerics.tolerance
        )
        g = bar.gravity_m_s2
        slope = values["inclination"]
        gravity = g * torch.stack([slope.sin(), torch.zeros_like(slope), -slope.cos()])
        load = float(run.setup.get("tip_load_mass_kg", 0.0)) * values["load_share"] * tip.edge
        parameters = {
            "youngs_modulus": values["youngs_modulus"],
            "rayleigh_beta": values["rayleigh_beta"],
            "density": values["density"],
            "gravity": gravity,
            "attached_mass": load,
        }
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        above = hand["held_above"] + float(run.setup.get("held_above_m", 0.0))
        lift = tip_stiffness(bar, values["youngs_modulus"]) * above
        holding = propping_force(bar, values["density"], tip, load)
        holding = holding + (tip.shares * lift)[:, None] * up
        along = (tip.body.x_rest[:, 0] / bar.length_m + 1.0)[:, None]
        return SoftScene(
            body=tip.body,
            sample_times=torch.as_tensor(np.asarray(run.time_s), dtype=torch.float64),
            observe=tip.look,
            axes=tip.seen.axes,
            parameters=parameters,
            start="equilibrium",
            holding_force=holding,
            start_velocity=hand["push"] * along**2 * up,
            friction_shares=tip.shares,
            clock_offset=hand["release_time"],
            output_maps=(lambda y, t: _cameras(y, tip.seen, values, hand),),
        )

    @lru_cache(maxsize=8)
    def made(shape: tuple[int, int, int], dt: float, tolerance: float) -> BeamTip:
        return BeamTip(bar, channels, shape, dt, tolerance, integrator, poissons_ratio)

    return SoftModel(build, (*base, *own), "released beam")


class BeamTip:
    """The bar on one mesh, its tip face and what is seen of it."""

    def __init__(
        self,
        bar: BeamGeometry,
        channels: Sequence[Channel],
        cells: tuple[int, int, int],
        dt_s: float,
        rtol: float,
        integrator: str,
        poissons_ratio: float,
    ):
        size = (bar.length_m, bar.width_m, bar.height_m)
        box = mesh.hex_box(cells, size, origin=(-bar.length_m, 0.0, 0.0))
        self.face = box.nodes_near_plane("x", 0.0)
        self.seen = tip_channels(bar, box.x_rest[self.face].numpy(), channels)
        volume = mesh.nodal_volume(box)
        self.shares = _spread(volume, self.face)
        upper = box.x_rest[self.face, 2] > bar.height_m - 1e-9
        self.edge = _spread(volume, self.face[upper])
        self.body = soft.SoftBody(
            box,
            dt=dt_s,
            integrator=integrator,
            youngs_modulus=bar.youngs_modulus_published_Pa,
            poissons_ratio=poissons_ratio,
            density=bar.density_kg_m3,
            gravity=(0.0, 0.0, -bar.gravity_m_s2),
            damping=soft.Damping(rayleigh_beta=1e-3),
            fixed=box.nodes_near_plane("x", -bar.length_m),
            masses=soft.Masses(attached_mass=torch.zeros_like(volume)),
            solver=soft.SolverOptions(rtol=rtol),
        )

    def look(self, x: Tensor) -> Tensor:
        """Channels of positions (..., num_nodes, 3), (..., num_channels)."""
        face = x[..., self.face, :].transpose(-1, -2)[..., list(self.seen.axes), :]
        return (self.seen.weights * face).sum(-1)


def propping_force(bar: BeamGeometry, density: Tensor, tip: BeamTip, load: Tensor) -> Tensor:
    """(num_nodes, 3) of a hand under the tip that holds the bar straight [N].

    The reaction of a propped cantilever, 3/8 of the bar's weight, and all of the tip's load.
    """
    g = bar.gravity_m_s2
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    prop = 0.375 * density * bar.mass_kg / bar.density_kg_m3 * g
    return (tip.shares * prop + load * g)[:, None] * up


def tip_stiffness(bar: BeamGeometry, youngs_modulus: Tensor) -> Tensor:
    """Force per displacement at the tip of a Bernoulli beam, 3 E I / L^3 [N/m]."""
    inertia = bar.width_m * bar.height_m**3 / 12.0
    return 3.0 * youngs_modulus * inertia / bar.length_m**3


def _spread(volume: Tensor, nodes: Tensor) -> Tensor:
    """(num_nodes,) shares of the nodes by the volume they stand for; they sum to 1."""
    out = torch.zeros_like(volume)
    out[nodes] = volume[nodes] / volume[nodes].sum()
    return out


def _cameras(
    y: Tensor, seen: TipChannels, values: Mapping[str, Tensor], hand: Mapping[str, Tensor]
) -> Tensor:
    """Displacements from the first sample, in the cameras' axes, of markers where they are."""
    y = y - y[:1]
    reach = torch.stack([values["marker_ahead"], values["marker_above"]])
    y = y + (y @ seen.pitch)[:, None] * (seen.lever @ reach)
    index = [i for i, _ in seen.partner]
    sign = torch.tensor([s for _, s in seen.partner], dtype=y.dtype)
    y = y + values["camera_pitch"] * sign * y[:, index]
    is_pitch = (seen.lever == 0.0).all(-1) & (seen.pitch != 0.0)
    y = torch.where(is_pitch, y * values["pitch_scale"], y)
    along = torch.stack([hand["zero_x"], 0.0 * hand["zero_x"], hand["zero_z"]])[list(seen.axes)]
    zero = torch.where(is_pitch, hand["zero_pitch"] * seen.pitch, along)
    return y - zero
