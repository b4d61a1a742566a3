"""What a rig is: somebody's machine with a cause hidden in it, recorded as anybody would."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Study

Array = NDArray[np.float64]
Size = tuple[float, ...]


@dataclass(frozen=True)
class Cause:
    """A cause that a rig can hide."""

    typical: float  # a size to begin the search for a wanted visibility with
    signed: bool = False  # whether its size may be negative
    components: int = 1  # number of its amplitudes; several are drawn in a random direction
    one_place: bool = False  # whether only one of its components differs from zero
    # what libraries call it, the first of them with the generator's sizes; the others say exactly
    # the same. Empty: its own name.
    names: tuple[str, ...] = ()
    known: bool = True  # whether libraries hold it at all
    # whether its size is one of the library's; else no interval can be held against it
    sized: bool = True
    most: float = np.inf  # largest size that makes sense


@dataclass(frozen=True, eq=False)
class Recorded:
    """Recordings of a rig, with and without the noise of its sensors."""

    study: Study  # what a diagnosis sees
    clean: Study  # the same samples without noise
    # True base parameters by the model's names, as far as they are known
    base: Mapping[str, float] = field(default_factory=dict)


class Rig(Protocol):
    """A machine that can be recorded with a cause hidden in it.

    Attributes:
        name: Of the machine.
        causes: What it can hide, by the generator's names.
        setup_file: Model of the machine; None: its studies describe it.
        disturbances: Troubles of its recordings that are no cause.
    """

    @property
    def name(self) -> str: ...

    @property
    def causes(self) -> Mapping[str, Cause]: ...

    @property
    def setup_file(self) -> Path | None: ...

    @property
    def disturbances(self) -> tuple[str, ...]: ...

    def record(self, seed: int, hidden: Mapping[str, Size], disturbance: str) -> Recorded:
        """Record the machine; of one seed, only what is hidden differs.

        Args:
            seed: Of true parameters, commands and noise.
            hidden: Sizes of what is hidden, by the generator's names.
            disturbance: One of ``disturbances``, or "" for none.
        """
        ...


def drawn_direction(rng: np.random.Generator, cause: Cause) -> Size:
    """Signs and shares of the components of a size one."""
    if cause.components == 1:
        return (float(rng.choice([-1.0, 1.0])) if cause.signed else 1.0,)
    direction = np.zeros(cause.components)
    if cause.one_place:
        direction[int(rng.integers(cause.components))] = rng.choice([-1.0, 1.0])
        direction = direction if cause.signed else np.abs(direction)
    else:
        direction = rng.standard_normal(cause.components)
        direction = direction if cause.signed else np.abs(direction)
    return tuple(float(x) for x in direction / np.linalg.norm(direction))
