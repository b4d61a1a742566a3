"""Names of coordinates: base parameters by their own, components of effects as "wind.x"."""

from __future__ import annotations

from collections.abc import Sequence

from diffsim.data.study import Run
from diffsim.identify.effect import Effect


def effect_coordinates(effects: Sequence[Effect]) -> tuple[str, ...]:
    """Names of the components; the effect's own where it has only one."""
    return tuple(
        e.name if len(e.components) == 1 else f"{e.name}.{c}" for e in effects for c in e.components
    )


def touches(name: str, run: Run) -> bool:
    """Whether a coordinate acts in a run: "offset@run_3" acts in run_3 only, "drag[frame=A]" where
    the run's setup says so."""
    if name.endswith("]") and "=" in name:
        key, _, label = name[name.rindex("[") + 1 : -1].partition("=")
        return key not in run.setup or str(run.setup[key]) == label
    return "@" not in name or name.rsplit("@", 1)[1] == run.name
