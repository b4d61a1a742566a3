"""Sealed cases: data in one folder, label and salt in another, a hash that ties them together.

``python -m tests.hidden.seal DATA VAULT --seed 7 --num 40`` draws the cases. A diagnosis gets the
data folder only; afterwards :func:`open_label` checks that the label is the one that was sealed.
The hash is of salt and label, so that the few possible labels cannot be tried out against it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import secrets
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from diffsim._files import to_plain, write_json_atomic, write_text_atomic
from diffsim.data.labs import DECOYS, LABS
from diffsim.data.study_file import save_study

HASH_FILE = "label.sha256"
KINDS = ("null", "decoy", "single", "pair", "outside")
SHARES = (0.2, 0.15, 0.4, 0.15, 0.1)
SIZE_RANGE = (0.3, 2.0)  # of the typical size, drawn log-uniformly
SIGNED = {"wind", "body_tilt", "centre_of_mass", "tilt", "current", "temperature_drift",
          "sensor_scale", "tip_scale", "viscosity", "temperature_gradient", "pump_gain",
          "meter_gain", "pressure_offset", "pressure_scale", "accelerometer_scale",
          "gyro_offset", "thrust_curvature"}  # fmt: skip
ONE_PLACE = {"weak_rotor", "blocked_branch", "meter_gain", "pressure_offset"}


def draw_label(rng: np.random.Generator, systems: Sequence[str] = tuple(LABS)) -> dict[str, Any]:
    """What a case hides: system, kind, effects with sizes, decoys, seed."""
    system, kind = str(rng.choice(list(systems))), str(rng.choice(KINDS, p=SHARES))
    known = LABS[system].effects
    inside = [name for name, effect in known.items() if not effect.outside]
    outside = [name for name, effect in known.items() if effect.outside]
    count = {"single": 1, "pair": 2, "outside": 1}.get(kind, 0)
    names = rng.choice(outside if kind == "outside" else inside, count, replace=False)
    return {
        "system": system,
        "kind": kind,
        "effects": {str(name): _draw_size(rng, system, str(name)) for name in names},
        "decoys": [str(rng.choice(list(DECOYS)))] if kind == "decoy" else [],
        "seed": int(rng.integers(2**31)),
    }


def _draw_size(rng: np.random.Generator, system: str, name: str) -> list[float]:
    """Random size, place and sign."""
    effect = LABS[system].effects[name]
    low, high = np.log(SIZE_RANGE)
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


def seal(label: dict[str, Any], data: Path, vault: Path, case: str) -> Path:
    """Hide the label, then make the data.

    Args:
        label: From ``draw_label``.
        data: ``data/case`` gets the study and the hash, nothing that names the cause.
        vault: ``vault/case.json`` gets label, truth and salt; must be outside ``data``.
        case: Name of the case; must not hint at the label.

    Returns:
        The case's data folder.
    """
    if vault.resolve().is_relative_to(data.resolve()):
        raise ValueError(f"vault {vault} must lie outside the data folder {data}")
    made = LABS[label["system"]]().case(label["seed"], label["effects"], label["decoys"])
    text = json.dumps(to_plain({"label": label, "truth": made.truth}), sort_keys=True)
    salt = secrets.token_hex(32)
    write_json_atomic(vault / f"{case}.json", {"salt": salt, "sealed": text})
    # the study's own name carries the seed, from which the case could be made again
    save_study(replace(made.study, name=case), data / case)
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


def _hash(salt: str, text: str) -> str:
    return hashlib.sha256((salt + text).encode("utf-8")).hexdigest()


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("vault", type=Path)
    parser.add_argument("--num", type=int, default=10)
    parser.add_argument("--seed", type=int, help="fresh and printed if not given")
    parser.add_argument("--system", choices=list(LABS), action="append")
    args = parser.parse_args(arguments)
    seed = secrets.randbits(31) if args.seed is None else args.seed
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    for i in range(args.num):
        label = draw_label(rng, args.system or tuple(LABS))
        seal(label, args.data, args.vault, f"case_{i:03d}")
        print(args.data / f"case_{i:03d}")


if __name__ == "__main__":
    main()
