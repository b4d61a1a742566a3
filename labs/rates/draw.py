"""What a case hides, from a master seed and its place alone."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from labs.rates.domains import DOMAINS, missing_package
from labs.rates.rig import Cause, Rig, Size, drawn_direction

NULL, LIBRARY, DENIED = "null", "library", "denied"
KINDS = (NULL, LIBRARY, DENIED)  # a third of the cases each
LAMBDAS = (3.0, 30.0)  # range of the wanted visibility, drawn log-uniformly
TROUBLED = 0.5  # share of cases whose recordings have a trouble that is no cause
ROW, FAMILY = "row", "family"  # what a denied library lacks: the cause's row, its whole family


@dataclass(frozen=True)
class Draw:
    """The content of a case."""

    rig: Rig  # machine that is recorded
    kind: str  # one of ``KINDS``
    hidden: str  # name of the hidden cause, as the rig calls it; empty: none
    direction: Size  # its components at a size of one
    wanted: float  # visibility that it should have
    trouble: str  # disturbance of the recordings; empty: none
    denies: str  # whether a denied library lacks the row or the family of what is hidden
    seed: int  # of the rig's true parameters, commands and noise

    @property
    def cause(self) -> Cause:
        """The hidden cause."""
        return self.rig.causes[self.hidden]

    def sizes(self, size: float) -> dict[str, Size]:
        """What is hidden at a size."""
        if not self.hidden:
            return {}
        return {self.hidden: tuple(size * share for share in self.direction)}


def draw(master: int, domain: str, index: int) -> Draw:
    """Draw the content of a case.

    Args:
        master: Master seed of all domains.
        domain: One of ``DOMAINS``.
        index: Number of the case in its domain.
    """
    key = (zlib.crc32(domain.encode()), index)
    rng = np.random.default_rng(np.random.SeedSequence(master, spawn_key=key))
    rigs = DOMAINS[domain]
    rig = rigs[int(rng.integers(len(rigs)))]
    kind = KINDS[index % len(KINDS)]
    names = [n for n, cause in rig.causes.items() if kind == DENIED or cause.known]
    hidden = str(rng.choice(names)) if kind != NULL else ""
    wanted = float(np.exp(rng.uniform(*np.log(LAMBDAS))))
    is_troubled = bool(rng.random() < TROUBLED) and bool(rig.disturbances)
    trouble = str(rng.choice(rig.disturbances)) if is_troubled else ""
    return Draw(
        rig,
        kind,
        hidden,
        drawn_direction(rng, rig.causes[hidden]) if hidden else (),
        wanted if hidden else 0.0,
        trouble,
        str(rng.choice([ROW, FAMILY])),
        int(rng.integers(2**31)),
    )


def recordable(master: int, domain: str, count: int) -> list[int]:
    """The first cases of a domain whose rigs can be recorded here.

    Args:
        master: Master seed.
        domain: One of ``DOMAINS``.
        count: Number of cases.
    """
    if all(missing_package(rig) for rig in DOMAINS[domain]):
        return []
    found: list[int] = []
    index = 0
    while len(found) < count:
        if missing_package(draw(master, domain, index).rig) is None:
            found.append(index)
        index += 1
    return found
