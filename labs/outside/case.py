"""A case: recordings of somebody else's simulator, a description by diffsim, the sealed answer."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Channel, Run, Study

Array = NDArray[np.float64]
Record = Callable[[Run], Array]  # what the outside simulator gives, without noise


@dataclass(frozen=True, eq=False)
class Case:
    """What is diagnosed, and apart from it what was hidden."""

    study: Study  # noisy recordings with the description of the system; all that a diagnosis sees
    clean: Study  # the same without noise
    kind: str  # "single", "null" or "outside" (beyond the library)
    # size of what was hidden by name of the cause; None: the size has no number
    hidden: Mapping[str, float | None] = field(default_factory=dict)
    # other names that say the same: no data of this study could tell them apart
    also: tuple[str, ...] = ()
    findings: tuple[str, ...] = ()  # base parameters that are far off their data sheet
    # True base parameters by the description's names, as far as they are known
    base: Mapping[str, float] = field(default_factory=dict)


Maker = Callable[[int], Case]


def recorded(
    name: str,
    channels: Sequence[Channel],
    runs: Sequence[Run],
    record: Record,
    model: Mapping[str, Any],
    rng: np.random.Generator,
) -> tuple[Study, Study]:
    """A study with noise of the channels' sd, and the same without.

    Args:
        name: Name of the study.
        channels: Channels with their noise.
        runs: Runs with commands, nothing measured yet.
        record: The outside simulator.
        model: Description of the system.
        rng: Source of the noise.
    """
    sd = np.array([c.sd for c in channels])
    clean = [replace(run, measured=record(run)) for run in runs]
    noisy = [
        replace(r, measured=r.measured + sd * rng.standard_normal(r.measured.shape)) for r in clean
    ]
    study = Study(name, str(model["system"]), tuple(channels), tuple(noisy), model=model)
    return study, replace(study, runs=tuple(clean))


def plan(
    time: Array, commands: Mapping[str, Mapping[str, Array]], test: str, num_channels: int
) -> list[Run]:
    """Two runs of every command, one of the command for the test.

    Args:
        time: Sample times [s].
        commands: Columns of each command group, by name of the group.
        test: Group that is kept for the test.
        num_channels: Number of channels.
    """
    runs: list[Run] = []
    blank = np.zeros((len(time), num_channels))
    for group, columns in commands.items():
        for tail in ("",) if group == test else ("_a", "_b"):
            use = "test" if group == test else "fit"
            runs.append(Run(group + tail, time, blank, dict(columns), group, len(runs), use))
    return runs


def off(rng: np.random.Generator, value: float, share: float) -> float:
    """A true value within about one prior sd of the data sheet's."""
    return value * float(np.exp(share * np.clip(rng.standard_normal(), -1.5, 1.5)))
