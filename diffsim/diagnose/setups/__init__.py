"""From a study to everything its diagnosis needs: model, candidate causes, runs to record next.

A study names its setup in the metadata, ``setup: silicone_beam`` or, with options, ``setup: {name:
silicone_beam, cells: [10, 2, 2]}``. Each setup is a module of this package with a function
``setup(study, **options) -> DiagnosisSetup``, imported when asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from diffsim._check import require_choice
from diffsim.data.study import Run, Study
from diffsim.diagnose.effect import Effect
from diffsim.diagnose.model import SimModel
from diffsim.diagnose.stages import DiagnosisSettings
from diffsim.diagnose.unknown import Unknown

SETUPS = (
    "lab_beam",
    "lab_copter",
    "lab_network",
    "silicone_beam",
    "starfish",
    "tennis_balls",
    "pneumatic_arm",
    "fish_tail",
    "rotor_bench",
    "cube_toss",
    "silicone_tensile",
)


@dataclass(frozen=True, eq=False)
class DiagnosisSetup:
    """What ``diagnose`` is given beside the study.

    Attributes:
        model: Of the recorded system.
        effects: Candidate causes.
        unknowns: Generic causes of this system; drifts of channels are added by ``diagnose``.
        bank: Runs that could be recorded next.
        settings: Effort.
        study: What is diagnosed, where a setup cuts or combines the recordings; None: as recorded.
    """

    model: SimModel
    effects: tuple[Effect, ...]
    unknowns: tuple[Unknown, ...] = ()
    bank: tuple[Run, ...] = ()
    settings: DiagnosisSettings = field(default_factory=DiagnosisSettings)
    study: Study | None = None


def setup_of(study: Study, **options: Any) -> DiagnosisSetup:
    """The setup that a study names.

    Args:
        study: With ``setup`` in its metadata.
        **options: Win over those of the study.

    Raises:
        ValueError: the study names none, or one that does not exist.
    """
    given = study.metadata.get("setup")
    if given is None:
        raise ValueError(
            f"study {study.name}: metadata has no ``setup``, so no model is known for it; name one "
            f"of {', '.join(SETUPS)}, or call diffsim.diagnose.diagnose with a model of your own"
        )
    entry = dict(given) if isinstance(given, Mapping) else {"name": given}
    if "name" not in entry:
        raise ValueError(
            f"study {study.name}: metadata ``setup`` must be a name or a mapping with ``name``, "
            f"got {given!r}"
        )
    name = require_choice(f"study {study.name}: setup", str(entry.pop("name")), SETUPS)
    made: DiagnosisSetup = import_module(f"diffsim.diagnose.setups.{name}").setup(
        study, **{**entry, **options}
    )
    return made


__all__ = ["SETUPS", "DiagnosisSetup", "setup_of"]
