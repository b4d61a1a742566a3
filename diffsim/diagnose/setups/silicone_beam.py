"""The recorded silicone beam (``import_study("silicone_beam")``): model, causes, next runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from diffsim.data.beam import TIP_MARKERS, BeamGeometry
from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose.beds.soft import forces, material, sensor
from diffsim.diagnose.beds.soft.hanging import SlackString
from diffsim.diagnose.beds.soft.released import pitch_weights, released_beam
from diffsim.diagnose.beds.soft.unknown import unknown_force
from diffsim.diagnose.effect import Effect
from diffsim.diagnose.search import SearchSettings
from diffsim.diagnose.setups import DiagnosisSetup
from diffsim.diagnose.stages import DiagnosisSettings
from diffsim.diagnose.unknown import UnknownForce, smooth_covariance

HELD_S = 0.05  # before release: what displacements are counted from
KNOTS_PER_S = 6.0
TIP = (
    Channel("tip_x_m", "m", "position"),
    Channel("tip_z_m", "m", "position"),
    Channel("tip_pitch_rad", "rad", "angle"),
)


def causes() -> tuple[Effect, ...]:
    """Candidates. Left out is what the base parameters are already: stiffness-proportional damping
    (rayleigh_beta), tilt (inclination), placement and tilt of cameras and a late clock; drift over
    the runs, whose order is not recorded; and the actuators, of which there are none.
    """
    return (
        material.LossFactor(),
        material.Creep(),
        material.Stiffening(),
        material.StiffnessLoss(),
        forces.LinearDrag(),
        forces.QuadraticDrag(),
        forces.DryFriction(),
        forces.Weight(),
        sensor.ClockRate(),
        sensor.SensorScale(),
        SlackString(),
    )


def setup(
    study: Study,
    *,
    cells: Sequence[int] = (6, 1, 2),
    dt_s: float = 4e-3,
    integrator: str = "implicit_midpoint",
    search: SearchSettings | None = None,
    accept_numerics: bool = False,
) -> DiagnosisSetup:
    """The released bar, its causes and what could be recorded next.

    Args:
        study: As imported, or what :func:`tip_window` makes of it, which is what this setup is for:
            the mean marker and the rotation of the tip in the plane of the bar, soon after release.
        cells: Elements along, across and up.
        dt_s: Time step [s].
        integrator: Of the body.
        search: Effort.
        accept_numerics: Go on although the mesh moves the record by more than the noise, which the
            coarse one does (docs/measured/silicone_beam.md).
    """
    bar = geometry(study)
    along, across, up = (int(n) for n in cells)
    bank = _bank(study)
    model = released_beam(
        bar,
        study.channels,
        [run.name for run in (*study.runs, *bank)],
        cells=(along, across, up),
        dt_s=float(dt_s),
        integrator=integrator,
    )
    until_s = max(float(run.time_s[-1]) for run in study.runs)
    return DiagnosisSetup(
        model,
        causes(),
        unknowns=(_smooth_force(until_s),),
        bank=bank,
        settings=DiagnosisSettings(
            search=search or SearchSettings(max_effects=3, num_refits=3, max_rounds=5),
            accept_numerics=accept_numerics,
            noise_rounds=1,
        ),
    )


def tip_window(study: Study, *, until_s: float = 2.5) -> Study:
    """Mean place and pitch of the tip, from just before release to ``until_s``.

    Sideways motion is left out: the hand gives it, and nothing in the model does. Noise is not
    stated any more: that of the cameras (3 to 10 um) is far below what two equal releases by hand
    differ by, so it is taken from the repeats.
    """
    bar = geometry(study)
    names = [c.name for c in study.channels]
    columns = np.zeros((len(names), 3))
    for marker, turn in zip(TIP_MARKERS, pitch_weights(bar), strict=True):
        columns[names.index(f"{marker}_x_m"), 0] = 1.0 / len(TIP_MARKERS)
        columns[names.index(f"{marker}_z_m"), 1] = 1.0 / len(TIP_MARKERS)
        columns[names.index(f"{marker}_x_m"), 2] = turn

    def cut(run: Run) -> Run:
        inside = (run.time_s >= -HELD_S) & (run.time_s <= until_s)
        return replace(
            run,
            time_s=run.time_s[inside],
            measured=run.measured[inside] @ columns,
            command={name: values[inside] for name, values in run.command.items()},
        )

    return replace(study, channels=TIP, runs=tuple(cut(run) for run in study.runs))


def geometry(study: Study) -> BeamGeometry:
    """Size and material as the study's metadata state them."""
    shape, matter = study.metadata["geometry"], study.metadata["material"]
    places = shape["nominal_marker_position_in_model_frame_m"]
    return BeamGeometry(
        length_m=float(shape["length_m"]),
        width_m=float(shape["width_m"]),
        height_m=float(shape["height_m"]),
        density_kg_m3=float(matter["density_kg_m3"]),
        poissons_ratio=float(matter["poisson_ratio"]),
        youngs_modulus_published_Pa=float(matter["youngs_modulus_Pa_used_by_authors"]),
        gravity_m_s2=float(matter["gravity_m_s2_used_by_authors"]),
        marker_place_m={n: (float(p[0]), float(p[1]), float(p[2])) for n, p in places.items()},
    )


def _smooth_force(until_s: float) -> UnknownForce:
    """In the plane of the bar: knots in time, even and growing along it; nothing sideways."""
    count = max(4, round(KNOTS_PER_S * until_s) + 1)
    knots = np.linspace(0.0, until_s, count)
    in_time = smooth_covariance(knots, 2.0 * until_s / (count - 1))
    effect = unknown_force(count, until_s, axes="z")
    both = np.kron(np.eye(2), in_time).astype(np.float64)
    return UnknownForce(effect, both)


def _bank(study: Study) -> tuple[Run, ...]:
    """Releases that could be recorded: other weights, and a quarter and twice the height."""
    like = study.fit_runs[0]
    out = []
    for name, load_kg in (("weight_0g", 0.0), ("weight_20g", 0.02), ("weight_100g", 0.1)):
        out.append(
            replace(
                like,
                name=name,
                group=name,
                measured=np.zeros_like(like.measured),
                setup={**like.setup, "tip_load_mass_kg": load_kg},
            )
        )
    for name, height_m in (("released_at_half_sag", -3.5e-3), ("released_7mm_higher", 7e-3)):
        out.append(
            replace(
                like,
                name=name,
                group=name,
                measured=np.zeros_like(like.measured),
                setup={**like.setup, "tip_load_mass_kg": 0.0, "held_above_m": height_m},
            )
        )
    return tuple(out)
