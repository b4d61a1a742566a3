"""What the demo shows of the recorded silicone beam: the bar without weight, its first swing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from diffsim.data.beam import TIP_MARKERS, BeamGeometry
from diffsim.data.study import Channel, Run, Study
from diffsim.identify.effect import Effect
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.setup import DiagnosisSetup
from diffsim.identify.unknown import UnknownForce, smooth_covariance
from diffsim.systems.soft_body import forces, material
from diffsim.systems.soft_body.released import pitch_weights
from diffsim.systems.soft_body.support import COMMANDS, SUPPORT_MOTION
from diffsim.systems.soft_body.swinging import swinging_beam
from diffsim.systems.soft_body.unknown import unknown_force

HELD_S = 0.05  # before release: what displacements are counted from
FREE_S, UNTIL_S = 0.25, 1.0
KNOTS_PER_S = 12.0
SUPPORT_HZ = 20.0  # above the bar's first mode (8 Hz), below its second (about 40 Hz)
TIP = (
    Channel("tip_x_m", "m", "position"),
    Channel("tip_z_m", "m", "position"),
    Channel("tip_pitch_rad", "rad", "angle"),
)
HEIGHT = "tip_z_m"
REPEAT = "_b"  # ends the name of a case's second recording


def causes() -> tuple[Effect, ...]:
    """Candidates. Left out is what base parameters are already: stiffness-proportional damping
    (rayleigh_beta), tilt (inclination), where the held tip is; and what a height alone cannot
    separate from them: scale of the sensor (with the swings), rate of its clock (with Young's
    modulus).
    """
    return (
        material.LOSS_FACTOR,
        material.CREEP,
        material.STIFFENING,
        forces.LINEAR_DRAG,
        forces.QUADRATIC_DRAG,
        forces.DRY_FRICTION,
        forces.WEIGHT,
        SUPPORT_MOTION,
    )


def setup(
    study: Study,
    *,
    cells: Sequence[int] = (8, 3, 3),
    dt_s: float = 5e-3,
    from_s: float = FREE_S,
    until_s: float = UNTIL_S,
    with_weight: bool = False,
    search: SearchSettings | None = None,
    accept_numerics: bool = False,
) -> DiagnosisSetup:
    """The height of the tip while the bar swings freely, its causes, what could be recorded next.

    Args:
        study: Study as imported.
        cells: Elements along, across and up.
        dt_s: Time step of the simulation [s].
        from_s, until_s: Begin and end of what is compared, after the release [s]. Before, hand and
            string act: no two releases by hand are alike (docs/measured/silicone_beam.md).
        with_weight: Whether the runs with the weight are judged, too. How it hangs is not modeled.
        search: Effort of the search; None: the default for this system.
        accept_numerics: Go on although time step or mesh move the record by more than the noise.
    """
    bar = geometry(study)
    along, across, up = (int(n) for n in cells)
    swing = free_swing(study, from_s=from_s, until_s=until_s)
    light = tuple(r for r in swing.runs if not r.setup.get("tip_load_mass_kg", 0.0) > 0.0)
    if light and not with_weight:
        swing = replace(swing, runs=light)
    bank = _bank(swing)
    heights = {run.name: run.measured[:, 0] for run in swing.runs}
    swings_m = {name: float(z[0] - z.mean()) for name, z in heights.items()}
    model = swinging_beam(
        bar,
        swing.channels,
        swings_m | {run.name: run.setup["swing_m"] for run in bank},
        cells=(along, across, up),
        dt_s=float(dt_s),
        since_s=float(from_s),
    )
    return DiagnosisSetup(
        model,
        causes(),
        unknowns=(_smooth_force(until_s - from_s),),
        bank=bank,
        settings=DiagnosisSettings(
            search=search or SearchSettings(max_effects=3, num_refits=2, max_rounds=4),
            accept_numerics=accept_numerics,
            noise_rounds=1,
        ),
        study=swing,
    )


def free_swing(study: Study, *, from_s: float = FREE_S, until_s: float = UNTIL_S) -> Study:
    """Height of the tip from ``from_s`` to ``until_s`` after release, its clock started anew.

    The second recording of each case is held out. Where the clamp was recorded it is no repeat of
    the first: the clamp sways otherwise, which is an input. So noise is what the study states for
    its worst marker.
    """
    late = tip_window(study, until_s=until_s)
    which = [c.name for c in late.channels].index(HEIGHT)
    channel = late.channels[which]
    is_seen = all(set(COMMANDS) <= set(run.command) for run in study.runs)
    if is_seen:
        stated = max((c.sd for c in study.channels if c.sd is not None), default=None)
        channel = replace(channel, sd=stated)

    def cut(run: Run) -> Run:
        inside = run.time_s >= from_s
        return replace(
            run,
            time_s=run.time_s[inside] - run.time_s[inside][0],
            measured=run.measured[inside][:, [which]],
            command={name: values[inside] for name, values in run.command.items()},
            group=run.name if is_seen else run.group,
            use="test" if run.name.endswith(REPEAT) else run.use,
        )

    return replace(late, channels=(channel,), runs=tuple(cut(r) for r in late.runs))


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
        commands = {n: _smooth(run, v) if n in COMMANDS else v for n, v in run.command.items()}
        return replace(
            run,
            time_s=run.time_s[inside],
            measured=run.measured[inside] @ columns,
            command={name: values[inside] for name, values in commands.items()},
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


def _smooth(run: Run, values: np.ndarray) -> np.ndarray:
    """Without what is faster than ``SUPPORT_HZ``, forwards and backwards: no delay.

    The support's acceleration is what acts; differences would be all noise.
    """
    from scipy.signal import butter, filtfilt

    rate_Hz = 1.0 / float(np.median(np.diff(run.time_s)))
    return np.asarray(filtfilt(*butter(4, SUPPORT_HZ, fs=rate_Hz), values))


def _smooth_force(until_s: float) -> UnknownForce:
    """Force in the plane of the bar: knots in time, even and growing along it; nothing sideways."""
    count = max(4, round(KNOTS_PER_S * until_s) + 1)
    knots = np.linspace(0.0, until_s, count)
    in_time = smooth_covariance(knots, 2.0 * until_s / (count - 1))
    effect = unknown_force(count, until_s, axes="z")
    both = np.kron(np.eye(2), in_time).astype(np.float64)
    return UnknownForce(effect, both)


def _bank(study: Study) -> tuple[Run, ...]:
    """Swings that could be recorded: other weights, and larger ones."""
    like = study.fit_runs[0]
    # nobody knows how the support would sway
    still = {n: np.zeros_like(v) if n in COMMANDS else v for n, v in like.command.items()}
    like = replace(like, command=still)
    out = []
    for load_kg in (0.0, 0.02, 0.1):
        for swing_m in (3e-3, 8e-3):
            name = f"weight_{1e3 * load_kg:.0f}g_swing_{1e3 * swing_m:.0f}mm"
            chosen = {**like.setup, "tip_load_mass_kg": load_kg, "swing_m": swing_m}
            blank = np.zeros_like(like.measured)
            out.append(replace(like, name=name, group=name, measured=blank, setup=chosen))
    return tuple(out)
