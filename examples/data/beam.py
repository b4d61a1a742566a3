"""The clamped silicone beam: four recordings, one frame, and what they can be trusted for.

Source and file layout: ``silicone_beam/README.md`` and ``metadata.yaml`` of the data folder
(Dubied et al., RA-L 2022, MIT licence). A soft bar, 30 x 30 x 100 mm, is clamped at one end, its
tip is held up by hand so that the bar is straight, then let go; ``gravity``: nothing else,
``load52``: a 52 g weight hangs from the tip. ``a`` and ``b`` are repeats.

Frame. Everything here is in the model frame: x from clamp to tip (bar in [-0.1, 0]), y lateral,
z up. The rotation and translation data -> model in the metadata were fitted to the nominal
marker places, which fit the data to 0.3-2 mm only: the triangle of tip markers alone asks for
4.7 degrees of pitch, the clamp's for 8.2, all six for the 6.6 that is used. Absolute places are
therefore never compared, only *displacements from the held state* (median of frames 20-34).

What the recordings show, and a model has to know (numbers: tests/examples/data/test_beam.py, and
the demo's report):

- *The weight is a mass, not a force.* 7.7 Hz without it, 4.3 Hz with it. The ratio asks for a
  modal tip mass of 24 g, a quarter of the bar's 96 g, which is the textbook value: the weight
  moves with the tip. A constant force, as published, cannot change the frequency. Sideways the
  tip keeps swinging at 8 Hz, and slowly at about 1.1 Hz, as a pendulum of 0.2 m would pull it:
  the weight hangs on something limp.
- *The string probably goes slack at release* (an interpretation: no sensor is on it). The loaded
  tip pauses about 45 ms after release, 10 mm down, where a weight that falls freely would catch
  up with the tip.
- *The rubber creeps* by 3.5-4.7 % of the sag per decade of time. The level about which the beam
  swings 0.1 s after release is 10 % above the one it reaches after 4 s, so "the static sag" and
  "the frequency" give Young's moduli 6-10 % apart with any elastic model.
- *Held straight is not unloaded.* The tip turns by 5.0-5.1 degrees (gravity) between held and
  settled, where a bar that starts straight would turn by 4.4: the held tip points up by 0.6
  degrees, as a propped cantilever's does.
- *Tilt.* The tip's path from held to settled is perpendicular to a beam inclined by 5 to 6
  degrees against the laboratory axes (allowing for the markers' height above the axis and for
  foreshortening): the inclination is the beam's, not the markers'. Whether gravity follows the
  laboratory's z or the model's cannot be told; it would change the sag by 1 - cos 6.6 deg =
  0.7 %.
- *The clamp sways*: its markers follow the sag by 0.01-0.06 mm (gravity) and up to 0.14 mm
  (load52), about 1 % of it. Without weight they swing by +-0.09 mm forward at 8.2 Hz, as a stand
  does that the bar sets going; that is near enough to the bar's 7.9 Hz to matter
  (docs/measured/silicone_beam.md). Half hidden markers jump by up to 0.9 mm.
- *Damping*: without weight 0.049, whatever the amplitude, once the clamp's sway is taken into
  account (0.055 falling to 0.047 without); with it 0.051 *rising* to 0.12 below 0.5 mm while the
  frequency rises from 4.3 to 4.7 Hz, as dry friction where the weight hangs would do; other causes
  are not excluded.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffsim.core.inside import inside
from diffsim.core.yaml_text import read_yaml_file
from examples.data import vibration
from labs.markers import Recording, load_csv

Array = NDArray[np.float64]

TIP_MARKERS = ("tip1", "tip2", "tip3")
BASE_MARKERS = ("base1", "base2", "base3")
SETTLING_S = 0.15  # the tracker is settling (README)
HELD_FRAMES = slice(20, 35)  # as the metadata's data -> model fit
RELEASE_SHARE = 0.05  # of the settled displacement: below it a hand may still move the tip
MAX_RELEASE_DISAGREEMENT = 2  # frames between our detector and the metadata's


@dataclass(frozen=True)
class BeamGeometry:
    """The bar and its material, as the source states them."""

    length_m: float
    width_m: float
    height_m: float
    density_kg_m3: float
    poissons_ratio: float
    youngs_modulus_published_Pa: float
    gravity_m_s2: float
    marker_place_m: dict[str, tuple[float, float, float]]

    @property
    def mass_kg(self) -> float:
        """Mass of the free length [kg]."""
        return self.density_kg_m3 * self.length_m * self.width_m * self.height_m


@dataclass(frozen=True)
class BeamTrial:
    """One recording, in the model frame."""

    name: str  # file stem, such as ``load52_a``
    case: str  # recordings of equal case are repeats of each other
    tip_load_N: float  # weight hanging from the tip
    tip_load_mass_kg: float  # mass hung from the tip until the release [kg]
    recording: Recording  # marker positions as the file has them, in the axes of the laboratory [m]
    # rotation from the axes of the laboratory to those of the model, (3, 3)
    rot_model_from_data: Array
    # first frame in which the tip is clearly on the way down, as stated in the metadata
    release_frame: int
    # the release that ``detect_release`` finds in the data; within 2 frames of ``release_frame``
    release_frame_detected: int
    release_s: float  # time of release between frames, on the recording's clock [s]
    time_s: Array  # (T,) since release [s], without the first 0.15 s of the recording
    # names of the markers at the tip that are compared with the simulation
    markers: tuple[str, ...]
    marker_displacement_m: Array  # (T, num_markers, 3) from the held state
    clamp_displacement_m: Array  # (T, 3) mean over the clamp's markers; NaN if it has none
    # (T, 3) of the point between the clamp's first two markers, nominally on the bar's axis (the
    # third jumps in the load cases); NaN if it has none
    support_displacement_m: Array

    @property
    def tip_displacement_m(self) -> Array:
        """(T, 3) mean over the tip markers."""
        return self.marker_displacement_m.mean(axis=1)

    def after_release(self, until_s: float = np.inf) -> tuple[Array, Array]:
        """Times in [0, until_s] and the tip displacement (N, 3) then."""
        inside = (self.time_s >= 0.0) & (self.time_s <= until_s)
        return self.time_s[inside], self.tip_displacement_m[inside]

    def tip_rotation_deg(self) -> Array:
        """(3,) rotation vector of the tip markers, held -> settled, about x, y, z [degrees]."""
        places = self.recording.select(self.markers).position_m @ self.rot_model_from_data.T
        return rigid_rotation_deg(_median(places[HELD_FRAMES]), _median(places[-100:]))


@dataclass(frozen=True)
class BeamStudy:
    """All recordings of one beam."""

    trials: tuple[BeamTrial, ...]  # recordings, in the order of the metadata
    geometry: BeamGeometry  # length, width, height and clamp of the bar
    folder: Path  # folder that the study was read from
    metadata: dict[str, Any]  # everything that ``metadata.yaml`` holds
    is_virtual: bool  # made by a bundled virtual laboratory, not measured

    def repeats(self) -> dict[str, tuple[BeamTrial, ...]]:
        """Recordings by name of the case, repeats together."""
        cases: dict[str, tuple[BeamTrial, ...]] = {}
        for trial in self.trials:
            cases[trial.case] = (*cases.get(trial.case, ()), trial)
        return cases


def load_beam_study(folder: str | Path) -> BeamStudy:
    """Read ``metadata.yaml`` and all recordings it lists, checked, in the model frame.

    Raises:
        FileNotFoundError, ValueError: with the file and the entry at fault.
    """
    folder = Path(folder)
    path = folder / "metadata.yaml"
    if not path.is_file():
        raise FileNotFoundError(f"{path}: not found; a beam study needs metadata.yaml and its CSVs")
    meta = read_yaml_file(path)
    geometry = meta["geometry"]
    material = meta["material"]
    bar = BeamGeometry(
        length_m=float(geometry["length_m"]),
        width_m=float(geometry["width_m"]),
        height_m=float(geometry["height_m"]),
        density_kg_m3=float(material["density_kg_m3"]),
        poissons_ratio=float(material["poisson_ratio"]),
        youngs_modulus_published_Pa=float(material["youngs_modulus_Pa_used_by_authors"]),
        gravity_m_s2=float(material["gravity_m_s2_used_by_authors"]),
        marker_place_m={
            name: (float(x), float(y), float(z))
            for name, (x, y, z) in geometry["nominal_marker_position_in_model_frame_m"].items()
        },
    )
    return BeamStudy(
        trials=tuple(_trial(folder, entry) for entry in meta["trials"]),
        geometry=bar,
        folder=folder,
        metadata=meta,
        is_virtual=bool(meta.get("virtual", False)),
    )


def detect_release(time_s: Array, displacement_m: Array) -> tuple[int, float]:
    """Release from the data alone.

    Args:
        time_s: Times of the samples, (T,) [s].
        displacement_m: (T, 3) of the tip from its held state.

    Returns:
        The first frame more than 5 % of the way to the settled place, and the time at which
        a body in free fall would have had to start to be there [s]: with the whole bar unloaded,
        every point of it first falls freely.
    """
    settled = displacement_m[-100:].mean(axis=0)
    size = float(np.linalg.norm(settled))
    along = displacement_m @ (settled / size)
    frame, crossing = vibration.first_crossing(time_s, along, RELEASE_SHARE * size)
    return frame, crossing - float(np.sqrt(2.0 * RELEASE_SHARE * size / 9.81))


def rigid_rotation_deg(before: Array, after: Array) -> Array:
    """(3,) rotation vector of the best rigid motion between two sets of points (n, 3) [degrees].

    Needs three points that are not on one line.
    """
    a, b = before - before.mean(0), after - after.mean(0)
    return np.asarray(Rotation.align_vectors(b, a)[0].as_rotvec(degrees=True))


def _trial(folder: Path, entry: dict[str, Any]) -> BeamTrial:
    recording = load_csv(inside(folder, str(entry["file"]), "file"), metadata=entry)
    markers = recording.select(TIP_MARKERS).markers
    where = f"{folder / 'metadata.yaml'}, trial {entry['file']}"
    rot = np.array(entry["data_to_model_rotation"], dtype=np.float64)
    if rot.shape != (3, 3) or np.abs(rot @ rot.T - np.eye(3)).max() > 1e-4:
        raise ValueError(f"{where}: data_to_model_rotation must be a rotation matrix (3, 3)")
    displacement = _from_held(recording.select(markers), rot)
    if np.isnan(displacement[HELD_FRAMES]).any() or np.isnan(displacement).any():
        gaps = recording.select(markers).num_gaps
        raise ValueError(
            f"{recording.source}: {gaps} gaps in the tip markers; fill them before the study"
        )
    frame, release_s = detect_release(recording.time_s, displacement.mean(axis=1))
    stated = int(entry["release_frame_detected"])
    if abs(frame - stated) > MAX_RELEASE_DISAGREEMENT:
        raise ValueError(
            f"{where}: release_frame_detected is {stated}, but the tip starts to fall at frame "
            f"{frame}; correct the entry or the recording"
        )
    has_clamp = set(BASE_MARKERS) <= set(recording.markers)
    clamp = (
        _from_held(recording.select(BASE_MARKERS), rot)
        if has_clamp
        else np.full((len(recording.time_s), len(BASE_MARKERS), 3), np.nan)
    )
    used = recording.time_s >= recording.time_s[0] + SETTLING_S
    name = Path(entry["file"]).stem
    return BeamTrial(
        name=name,
        case=name.rsplit("_", 1)[0],
        tip_load_N=float(entry["tip_load_N"]),
        tip_load_mass_kg=float(entry["tip_load_mass_kg"]),
        recording=recording,
        rot_model_from_data=rot,
        release_frame=stated,
        release_frame_detected=frame,
        release_s=release_s,
        time_s=recording.time_s[used] - release_s,
        markers=markers,
        marker_displacement_m=displacement[used],
        clamp_displacement_m=clamp[used].mean(axis=1),
        support_displacement_m=clamp[used, :2].mean(axis=1),
    )


def _from_held(recording: Recording, rot: Array) -> Array:
    """(T, num_markers, 3) displacement from the held state, model axes."""
    held = np.nanmedian(recording.position_m[HELD_FRAMES], axis=0)
    return (recording.position_m - held) @ rot.T


def _median(places: Array) -> Array:
    return np.asarray(np.nanmedian(places, axis=0))
