"""Keys ``faults:`` of a study: groups of runs that are each judged for a fault of their own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, field_validator

from diffsim.core.schema import KindWords, Part


def _read_families(given: Any) -> Any:
    listed = given if isinstance(given, (list, tuple)) else [given]
    return tuple((v,) if isinstance(v, str) else v for v in listed)


Families = Annotated[
    tuple[tuple[str, ...], ...],
    BeforeValidator(_read_families),
    KindWords("list of texts or lists of text"),
]


class KnownFaults(Part):
    """What was done on purpose: groups that the scatter is learned from."""

    fact: str = Field(description="Fact of the runs that says what was done")
    causes: dict[str, tuple[str, ...]] = Field(
        description="By value of that fact, the causes that were changed: their sizes are free "
        "while the scatter is learned; [] for a sound system. Groups with other values teach "
        "nothing and are judged"
    )

    @field_validator("causes", mode="before")
    @classmethod
    def _one_or_more(cls, given: Any) -> Any:
        if not isinstance(given, Mapping):
            return given
        return {str(k): (v,) if isinstance(v, str) else v for k, v in given.items()}


class FaultKeys(Part):
    """Groups of runs, each with a fault of its own or none, and the scatter between groups."""

    per: str = Field(
        "group",
        description="Fact of the runs: runs with one value of it had the same fault on one day; "
        "`run`: each run for itself",
    )
    state: str | None = Field(
        None,
        description="Fact of the runs: a state of the rig that several groups share, such as a set "
        "of propellers. A group whose state is not known is weighed in each one that was seen, "
        "and in a new one",
    )
    scatter: Families = Field(
        description="Quantities of the model, stated `per` one of these facts or `per: run`, by "
        "which sound groups and runs differ: how far is learned, their `sd` is the first guess. "
        "Quantities in one list share one spread"
    )
    known: KnownFaults = Field(description="Groups that are sound, or changed in a known way")
    together: tuple[str, ...] = Field(
        (),
        description="Causes that may come together; each other cause comes alone. Default: none "
        "may, or all where `max_causes` is stated",
    )
    max_causes: int | None = Field(
        None, ge=1, le=20, description="Most causes in one group; default: 2 of those in `together`"
    )
    sizes: dict[str, float] = Field(
        {},
        description="Causes whose size is known, in their unit: {stuck: 1} of what is stuck or is "
        "not. They are judged at this size alone",
    )
    sound: float = Field(
        0.5, gt=0, lt=1, description="Probability that a group is sound, before it is seen"
    )
    learn_odds: bool = Field(
        True,
        description="Whether faults that known groups had often are expected more; what the "
        "runs alone cannot tell apart is said in any case",
    )
