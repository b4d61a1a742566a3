"""What a study describes otherwise than the one that a saved model was fitted to.

A fact of the set-up may well differ, such as a payload: it is said. What cannot be meant is
refused: another system, other parameters, another gravity on the same Earth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import hypot
from typing import Any

from diffsim.core.files import to_plain
from diffsim.data.study import Study
from diffsim.identify.model_file import SavedModel
from diffsim.identify.setup import DiagnosisSetup

KEY = "description"
MOST_NAMES = 4  # of parameters or causes in a message; of more, how many they are
_LIBRARY = "effects"  # causes that are weighed: those of the file are judged, whatever is offered
_STILL = "gravity"


def description_of(study: Study) -> dict[str, Any]:
    """How a study describes its system, for the file of a model that is fitted to it; empty where
    nothing is described."""
    return {} if study.model is None else {KEY: to_plain(dict(study.model))}


def require_same_kind(saved: SavedModel, study: Study) -> None:
    """Refuse the model of another kind of system, or of other channels, before any is built.

    Args:
        saved: Model that was fitted; files of before say less of their study.
        study: Study of new runs.

    Raises:
        ValueError: it is one; the message says which study it was fitted to.
    """
    now = (study.model or {}).get("system", study.system)
    was = saved.facts.get(KEY, {}).get("system", now)  # files of before do not say
    known = saved.facts.get("noise") or {channel.name: {} for channel in study.channels}
    lacks = [channel.name for channel in study.channels if channel.name not in known]
    if was == now and not lacks:
        return
    what = f"system {was}" if was != now else f"channels {', '.join(known)}"
    describes = f"system {now}" if was != now else f"channel {_join_names(lacks)}, too"
    raise ValueError(
        f"{saved.path}: a model of study {saved.study or '(not stated)'}, fitted to {what}; study "
        f"{study.name} has {describes}. Give the model that was fitted to this study with --model"
    )


def differences(saved: SavedModel, study: Study) -> tuple[str, ...]:
    """Every difference between two descriptions, a sentence each.

    Args:
        saved: Model that was fitted to one of them; files of before hold none.
        study: The other one.

    Raises:
        ValueError: a difference that cannot be meant.
    """
    before = saved.facts.get(KEY)
    if before is None or study.model is None:
        return ()
    was, now = _flat(before), _flat(to_plain(dict(study.model)))
    out = []
    for path in sorted({*was, *now}):
        if was.get(path) == now.get(path):
            continue
        if _STILL in path.split("."):
            _require_gravity(saved, path, was.get(path), now.get(path))
        out.append(
            f"study.yaml: model.{path} is {_say_value(now.get(path))}, the model was fitted with "
            f"{_say_value(was.get(path))}."
        )
    return tuple(out)


def require_same_system(saved: SavedModel, setup: DiagnosisSetup, study: Study) -> None:
    """Refuse the model of another study, which describes other parameters.

    Raises:
        ValueError: it is one; the message says which study and what differs.
    """
    known = {_stem(p.name) for p in setup.model.base}
    own = {_stem(name) for name in saved.parameters}
    if not own - known:
        return
    lacks, more = sorted(own - known), sorted(known - own)
    instead = f"; it has {_join_names(more)}" if more else ""
    raise ValueError(
        f"{saved.path}: a model of study {saved.study or '(not stated)'} ({saved.model}), which "
        f"study {study.name} ({setup.model.name}) does not describe: no parameter "
        f"{_join_names(lacks)} there{instead}. Give the model that was fitted to this system with "
        "--model"
    )


def _join_names(names: Sequence[str]) -> str:
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    return f"{', '.join(names[:MOST_NAMES])}{more}"


def _stem(name: str) -> str:
    return name.partition("@")[0].partition("[")[0]


def _flat(given: Any, path: str = "") -> dict[str, Any]:
    """Entries by their paths; a list of named things by their names; vectors whole."""
    if isinstance(given, Mapping):
        entries = {str(key): value for key, value in given.items()}
        if not path:
            entries.pop(_LIBRARY, None)
    elif isinstance(given, Sequence) and given and all(isinstance(g, Mapping) for g in given):
        entries = {str(g.get("name", k)): g for k, g in enumerate(given)}
    else:
        return {path: given}
    out = {} if entries else {path: None}
    for key, value in entries.items():
        out |= _flat(value, f"{path}.{key}" if path else key)
    return out


def _require_gravity(saved: SavedModel, path: str, was: Any, now: Any) -> None:
    """A rig may be turned; how strong gravity is does not change."""
    before, after = _strength(was), _strength(now)
    # from pole to equator it differs by 0.5 %
    if before and after and abs(after / before - 1.0) > 0.005:
        raise ValueError(
            f"study.yaml: model.{path} is {_say_value(now)}, {saved.path} was fitted with "
            f"{_say_value(was)}: gravity is the same for all recordings of a rig; state it as there"
        )


def _strength(given: Any) -> float:
    """Length of a vector, size of a number; 0 of anything else."""
    parts = given if isinstance(given, Sequence) and not isinstance(given, str) else [given]
    numbers = [p for p in parts if isinstance(p, (int, float)) and not isinstance(p, bool)]
    return hypot(*numbers) if len(numbers) == len(parts) else 0.0


def _say_value(value: Any) -> str:
    return "not stated" if value is None else str(value)
