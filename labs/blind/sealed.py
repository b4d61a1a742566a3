"""Sealed cases: data in one folder, label and salt in another, a hash that ties them together.

A diagnosis gets the data folder only; afterwards :func:`open_label` checks that the label is the
one that was sealed. The hash is of salt and label, so that the few possible labels cannot be tried
out against it. ``python -m labs.blind`` draws, diagnoses and scores such cases.
"""

from __future__ import annotations

import hashlib
import json
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.core.check import require_choice
from diffsim.core.files import to_plain, write_json_atomic, write_text_atomic
from diffsim.data.study import Study
from diffsim.data.study_save import save_study
from labs.virtual.channel_network import NetworkLab
from labs.virtual.common import DECOYS, Lab
from labs.virtual.multicopter import CopterLab
from labs.virtual.soft_beam import SoftBeamLab

HASH_FILE, OPTIONS_FILE = "label.sha256", "options.json"
#: Kind of a case -> its share of all.
KINDS: dict[str, float] = {
    "null": 0.17,
    "decoy": 0.12,
    "single": 0.33,
    "pair": 0.10,
    "outside": 0.08,
    "look_alike": 0.05,
    "confounded": 0.05,
    "twins": 0.03,
    "invisible": 0.04,
    "numerical": 0.03,
}
SIZE_RANGE = (0.3, 2.0)  # of the typical size, drawn log-uniformly
WIDE_RANGE = (0.3, 5.0)  # where the typical size of most causes is hardly visible
SIGNED = {"wind", "body_tilt", "center_of_mass", "tilt", "current", "temperature_drift",
          "sensor_scale", "tip_scale", "viscosity", "temperature_gradient", "pump_gain",
          "meter_gain", "pressure_offset", "pressure_scale", "accelerometer_scale",
          "gyro_offset", "thrust_curvature"}  # fmt: skip
ONE_PLACE = {"weak_rotor", "blocked_branch", "meter_gain", "pressure_offset"}


@dataclass(frozen=True)
class Blindfold:
    """Part of a study that is taken away, so that it cannot tell certain effects apart.

    Attributes:
        blank: Channels that were not recorded.
        without_runs: Runs for fitting whose name begins so are left out.
    """

    blank: tuple[str, ...] = ()
    without_runs: tuple[str, ...] = ()

    def __call__(self, study: Study) -> Study:
        """The study without it."""
        hidden = [c.name in self.blank for c in study.channels]
        kept = [
            replace(run, measured=np.where(hidden, np.nan, run.measured))
            for run in study.runs
            if run.use != "fit" or not run.name.startswith(self.without_runs or ("\0",))
        ]
        return replace(study, runs=tuple(kept))


@dataclass(frozen=True)
class Bench:
    """A laboratory and what can be hidden in it beyond single effects.

    Attributes:
        lab: Function that makes the laboratory.
        confounded: Effects that the rest of a study cannot part, and what is taken away.
        invisible: Effects that the rest of a study cannot show, and what is taken away.
        look_alike: Effects that others of their family mimic; hidden while the library lacks them.
        coarse: Factors on numerical settings that no diagnosis may accept.
        decoys: Names of the decoys that have a meaning in this laboratory.
        sizes: Range of hidden sizes over the typical ones; weak and strong ones should be in it.
    """

    lab: Callable[[], Lab]
    confounded: tuple[tuple[tuple[str, ...], Blindfold], ...] = ()
    invisible: tuple[tuple[str, Blindfold], ...] = ()
    look_alike: tuple[str, ...] = ()
    coarse: Mapping[str, float] = field(default_factory=dict)
    decoys: tuple[str, ...] = tuple(DECOYS)
    sizes: tuple[float, float] = SIZE_RANGE

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of cases that it can make."""
        missing = {
            "confounded": not self.confounded,
            "invisible": not self.invisible,
            "look_alike": not self.look_alike,
            "numerical": not self.coarse,
            "outside": not any(e.outside for e in self.lab().effects.values()),
        }
        return tuple(kind for kind in KINDS if not missing.get(kind, False))


# a commanded back pressure would tell as much as a sensor
_NO_PRESSURE = Blindfold(blank=("pump_Pa", "tap_Pa"), without_runs=("back_pressure",))
_NO_YAW = Blindfold(without_runs=("hover_yaw", "sprint"))
#: By the name that a user gives.
BENCHES: dict[str, Bench] = {
    "beam": Bench(
        SoftBeamLab,
        # one frequency cannot tell how a loss depends on it
        confounded=((("volume_drag", "loss_factor"), Blindfold(without_runs=("chirp", "steps"))),),
        # the chirp stays below the tension that saturates
        invisible=(("saturation", Blindfold(without_runs=("release", "steps"))),),
        look_alike=("loss_factor", "volume_drag", "lag", "delay"),
        coarse={"time_step": 8.0},
    ),
    "copter": Bench(
        CopterLab,
        confounded=((("wind", "body_tilt"), _NO_YAW),),
        invisible=(
            (
                "accelerometer_scale",
                Blindfold(blank=tuple(f"accelerometer_{a}_m_s2" for a in "xyz")),
            ),
            ("gyro_offset", Blindfold(blank=tuple(f"rate_{a}_rad_s" for a in "xyz"))),
        ),
        look_alike=("body_drag", "parasitic_drag", "lag", "delay"),
        coarse={"time_step": 8.0},
        # no flight is repeated, so none can be lost and scatter cannot be judged
        decoys=tuple(d for d in DECOYS if d not in ("lost_repeat", "scatter")),
    ),
    "network": Bench(
        NetworkLab,
        confounded=((("slip", "wall_offset"), _NO_PRESSURE),),
        invisible=(("viscosity", _NO_PRESSURE), ("pressure_scale", _NO_PRESSURE)),
        look_alike=("compliance", "thinning", "entrance_loss", "slip", "wall_offset"),
        coarse={"mesh": 3.0},
        sizes=WIDE_RANGE,
    ),
}


def draw_label(rng: np.random.Generator, bench: Bench, kinds: Sequence[str] = ()) -> dict[str, Any]:
    """Draw the content of a case: kind, effects with sizes, decoys, seed, and what is taken away.

    Args:
        rng: Source of every random choice.
        bench: Laboratory and what can be hidden in it.
        kinds: Only these; all that the bench can make if empty.

    Raises:
        ValueError: a kind that the bench cannot make.
    """
    for kind in kinds:
        require_choice("kinds", kind, bench.kinds)
    possible = [k for k in bench.kinds if not kinds or k in kinds]
    shares = np.array([KINDS[k] for k in possible])
    kind = str(rng.choice(possible, p=shares / shares.sum()))
    effects = bench.lab().effects
    inside = [name for name, effect in effects.items() if not effect.outside]
    label: dict[str, Any] = {"kind": kind, "effects": {}, "decoys": [], "options": {}}
    names: list[str] = []
    if kind == "decoy":
        label["decoys"] = [str(rng.choice(bench.decoys))]
    elif kind in ("single", "pair"):
        names = [str(n) for n in rng.choice(inside, {"single": 1, "pair": 2}[kind], replace=False)]
    elif kind == "outside":
        names = [str(rng.choice([name for name in effects if name not in inside]))]
    elif kind == "look_alike":
        names = [str(rng.choice(bench.look_alike))]
        label["options"] = {"without": names}
    elif kind == "twins":
        plain = [name for name in inside if effects[name].components == 1]
        names = [str(rng.choice(plain))]
        # another one beside it, so that the twins do not give the effect away
        others = [name for name in plain if name not in names]
        label["options"] = {"twins": sorted([*names, str(rng.choice(others))])}
    elif kind == "confounded":
        members, fold = bench.confounded[int(rng.integers(len(bench.confounded)))]
        names = [str(rng.choice(members))]
        label |= {"class": list(members), "blindfold": asdict(fold)}
    elif kind == "invisible":
        name, fold = bench.invisible[int(rng.integers(len(bench.invisible)))]
        names = [name]
        label["blindfold"] = asdict(fold)
    elif kind == "numerical":
        label["options"] = {"coarse": dict(bench.coarse)}
    label["effects"] = {name: _draw_size(rng, bench, name) for name in names}
    label["seed"] = int(rng.integers(2**31))
    plain_label: dict[str, Any] = to_plain(label)
    return plain_label


def _draw_size(rng: np.random.Generator, bench: Bench, name: str) -> list[float]:
    """Random size, place and sign."""
    effect = bench.lab().effects[name]
    low, high = np.log(bench.sizes)
    size = effect.typical * float(np.exp(rng.uniform(low, high)))
    if name in SIGNED:
        size *= float(rng.choice([-1.0, 1.0]))
    if effect.components == 1:
        return [size]
    direction = np.zeros(effect.components)
    if name in ONE_PLACE:
        direction[int(rng.integers(effect.components))] = 1.0
    else:
        direction = rng.standard_normal(effect.components)
        direction /= np.linalg.norm(direction)
    return [float(x) for x in size * direction]


def study_of(
    bench: Bench, label: Mapping[str, Any], *, noise: float = 1.0
) -> tuple[Study, dict[str, Any]]:
    """The study of a label, and the truth behind it; without noise where ``noise`` is 0."""
    made = bench.lab().case(label["seed"], label["effects"], label["decoys"], noise=noise)
    fold = {key: tuple(value) for key, value in label.get("blindfold", {}).items()}
    return Blindfold(**fold)(made.study), made.truth


def seal(bench: Bench, label: Mapping[str, Any], data: Path, vault: Path, case: str) -> Path:
    """Hide the label, then make the data.

    Args:
        bench: Laboratory and what can be hidden in it.
        label: What the case hides, as ``draw_label`` returns it.
        data: ``data/case`` gets the study, the hash, and what the diagnosis must know (which
            causes its library lacks, numerical settings), nothing that names the cause.
        vault: ``vault/case.json`` gets label, truth and salt; must be outside ``data``.
        case: Name of the case; must not hint at the label.

    Returns:
        The case's data folder.
    """
    if vault.resolve().is_relative_to(data.resolve()):
        raise ValueError(f"vault {vault} must lie outside the data folder {data}")
    study, truth = study_of(bench, label)
    text = json.dumps(to_plain({"label": dict(label), "truth": truth}), sort_keys=True)
    salt = secrets.token_hex(32)
    write_json_atomic(vault / f"{case}.json", {"salt": salt, "sealed": text})
    # the study's own name and title carry the seed, from which the case could be made again
    save_study(replace(study, name=case), data / case, overwrite=True)
    write_json_atomic(data / case / OPTIONS_FILE, label["options"])
    write_text_atomic(data / case / HASH_FILE, _hash(salt, text) + "\n")
    return data / case


def open_label(data: Path, vault: Path, case: str) -> dict[str, Any]:
    """Label and truth of a case, after checking them against the hash beside the data.

    Raises:
        ValueError: label or salt is not the one that was sealed.
    """
    stored = json.loads((vault / f"{case}.json").read_text(encoding="utf-8"))
    expected = (data / case / HASH_FILE).read_text(encoding="utf-8").strip()
    if _hash(stored["salt"], stored["sealed"]) != expected:
        raise ValueError(f"case {case}: the label in {vault} is not the one that was sealed")
    content: dict[str, Any] = json.loads(stored["sealed"])
    return content


def is_sealed(data: Path, vault: Path, case: str) -> bool:
    """Whether a case was made whole; the hash is written last."""
    return (data / case / HASH_FILE).is_file() and (vault / f"{case}.json").is_file()


def _hash(salt: str, text: str) -> str:
    return hashlib.sha256((salt + text).encode("utf-8")).hexdigest()
