"""From a study to everything its diagnosis needs: model, candidate causes, runs to record next.

A study names its setup in the metadata, ``setup: silicone_beam`` or, with options, ``setup: {name:
silicone_beam, cells: [10, 2, 2]}``. Each setup is a module of ``published`` or ``laboratories``
with a function ``setup(study, **options) -> DiagnosisSetup``, imported when asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from diffsim.core.check import require_choice
from diffsim.data.study import Study
from diffsim.identify.setup import DiagnosisSetup

_LABORATORIES = ("lab_beam", "lab_copter", "lab_network")
_PUBLISHED = (
    "silicone_beam",
    "starfish",
    "tennis_balls",
    "pneumatic_arm",
    "fish_tail",
    "rotor_bench",
    "cube_toss",
    "silicone_tensile",
)
SETUPS = (*_LABORATORIES, *_PUBLISHED)


def setup_of(study: Study, **options: Any) -> DiagnosisSetup:
    """The setup that a study names.

    Args:
        study: Study with the name of its ``setup`` in the metadata.
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
    room = "laboratories" if name in _LABORATORIES else "published"
    made: DiagnosisSetup = import_module(f"diffsim.systems.{room}.{name}").setup(
        study, **{**entry, **options}
    )
    return made


__all__ = ["SETUPS", "setup_of"]
