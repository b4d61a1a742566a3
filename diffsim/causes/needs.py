"""What a study must have for a cause to be judged, by the names that rows of causes use."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from diffsim.core.arrays import Array
from diffsim.data.study import Study
from diffsim.identify.effect import Needs, needs_nothing

FINE = 48  # values of a command that tell it from one that was rounded itself


def needs_command(study: Study) -> str | None:
    """Runs with a recorded command."""
    if not any(run.command for run in study.runs):
        return "runs with a recorded command"
    return None


def needs_fine_command(study: Study) -> str | None:
    """A recorded command of more values than the finest steps that a scan tries."""
    if (lacks := needs_command(study)) is not None:
        return lacks
    values = [
        np.unique(np.concatenate([run.command[name] for run in study.runs if name in run.command]))
        for name in {name for run in study.runs for name in run.command}
    ]
    most = max(len(np.unique(_digits(v[np.isfinite(v)]))) for v in values)
    if most < FINE:
        return f"a command of {FINE} values or more; the recorded one has {most}"
    return None


def needs_order(study: Study) -> str | None:
    """Runs enough for something to drift from one to the next."""
    return None if len({r.order for r in study.fit_runs}) > 2 else "three runs to fit"


def needs_levels(study: Study) -> str | None:
    """Commands of several levels: only these separate a cause from a constant."""
    levels = {round(float(v), 15) for r in study.runs for c in r.command.values() for v in c}
    return None if len(levels) > 1 else "two drive levels or more"


def needs_water(study: Study) -> str | None:
    """A fluid that drags."""
    if str(study.metadata.get("medium", "")) != "water":
        return 'a fluid that drags (metadata "medium: water")'
    return None


def needs_pressure(study: Study) -> str | None:
    """A pressure, which identifies a viscosity where pumps prescribe the flow."""
    commands = [c for run in study.fit_runs for n, c in run.command.items() if n.endswith("_Pa")]
    is_driven = any(bool((c != 0.0).any()) for c in commands)
    is_seen = any(c.kind == "pressure" for c in study.channels)
    return None if is_seen or is_driven else "a pressure channel"


def needs_pumps_and_pressure(study: Study) -> str | None:
    """Runs driven by flow, and a pressure."""
    if _has_regulators(study):
        return "runs driven by flow: a regulated pressure makes up for a leak ahead of it"
    return needs_pressure(study)


def needs_pumps(study: Study) -> str | None:
    """Runs driven by flow."""
    if _has_regulators(study):
        return "runs driven by flow: an open inlet finds its own profile"
    return None


def needs_impact(study: Study) -> str | None:
    """Tosses that go on through their impact."""
    if not any(run.setup.get("_hits") for run in study.runs):
        return "tosses recorded through their impact"
    return None


def _has_regulators(study: Study) -> bool:
    return any(name.startswith("pressure_in") for run in study.runs for name in run.command)


def _digits(values: Array) -> Array:
    """Values to six digits of the largest, so that rounding of a file makes none."""
    return np.round(values / max(float(np.abs(values).max(initial=0.0)), 1e-300), 6)


#: What rows name, and the function of a study that says what it lacks.
NEEDS: Mapping[str, Needs] = MappingProxyType(
    {
        "nothing": needs_nothing,
        "command": needs_command,
        "fine_command": needs_fine_command,
        "order": needs_order,
        "levels": needs_levels,
        "water": needs_water,
        "impact": needs_impact,
        "pressure": needs_pressure,
        "pumps": needs_pumps,
        "pumps_and_pressure": needs_pumps_and_pressure,
    }
)
