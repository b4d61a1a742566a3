"""Sets of causes that a group may have, and how probable each is before the group is seen."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from diffsim.core.check import did_you_mean
from diffsim.data.fault_keys import FaultKeys
from diffsim.identify.effect import Effect

UNLISTED = "unlisted"
UNLISTED_SHARE = 0.05  # of changed groups, whose change is not in the library
UNLISTED_FACTOR = 5.0  # spreads of such a group over those of others
PSEUDO_COUNT = 2.0  # known groups that the odds by number of causes alone weigh as much as


@dataclass(frozen=True)
class Candidate:
    """One explanation of a group.

    Attributes:
        causes: Causes that act; none: sound, or changed in a way that no cause describes.
        log_odds: Logarithm of its prior probability, by the number of causes alone.
        learned_odds: The same where faults that were frequent are expected more.
        is_unlisted: Whether the group differs more than sound ones do, by no cause of the library.
    """

    causes: tuple[str, ...]
    log_odds: float
    learned_odds: float
    is_unlisted: bool = False

    @property
    def is_sound(self) -> bool:
        """Whether nothing is wrong."""
        return not self.causes and not self.is_unlisted


def sets_of(keys: FaultKeys, effects: Sequence[Effect]) -> tuple[tuple[str, ...], ...]:
    """Sets of causes that may act at once, by number of causes.

    Raises:
        ValueError: a cause that the library does not have, or that has several components.
    """
    known = [e.name for e in effects]
    known_causes = (c for causes in keys.known.causes.values() for c in causes)
    named = [*keys.together, *keys.sizes, *known_causes]
    for name in named:
        if name not in known:
            raise ValueError(f"faults: no cause {name!r}{did_you_mean(name, known)}")
    for effect in effects:
        if len(effect.components) > 1:
            raise ValueError(f"faults: cause {effect.name} has several components; leave it out")
    for effect in effects:
        if not effect.signed and keys.sizes.get(effect.name, 1.0) <= 0.0:
            raise ValueError(f"faults.sizes.{effect.name}: must be above 0, it is one-sided")
    singles = [(name,) for name in known]
    together = keys.together or (known if keys.max_causes is not None else ())
    joint = [n for n in known if n in together]
    most = keys.max_causes if keys.max_causes is not None else 2
    more = [c for k in range(2, most + 1) for c in combinations(joint, k)]
    return (*singles, *more)


def candidates(
    keys: FaultKeys, sets: Sequence[tuple[str, ...]], seen: Sequence[tuple[str, ...]]
) -> tuple[Candidate, ...]:
    """Explanations with their odds: sound, every set, unlisted.

    What was seen n times counts as its square root: groups of one campaign are one decision of
    the experimenter, not n independent faults.

    Args:
        keys: ``faults`` of the study.
        sets: Sets of causes that may act at once.
        seen: Causes of the known groups, sound ones included; none of them is judged now.
    """
    sizes = [len(s) for s in sets]
    by_size = {k: 0.5**k for k in set(sizes)}
    whole = sum(by_size.values())
    plain = {s: by_size[len(s)] / whole / sizes.count(len(s)) for s in sets}
    faulty = Counter(tuple(sorted(s)) for s in seen if s) if keys.learn_odds else Counter()
    often = {s: np.sqrt(faulty[tuple(sorted(s))]) + PSEUDO_COUNT * p for s, p in plain.items()}
    learned = {s: n / sum(often.values()) for s, n in often.items()}
    changed = 1.0 - keys.sound
    listed = changed * (1.0 - UNLISTED_SHARE)
    out = [Candidate((), np.log(keys.sound), np.log(keys.sound))]
    out += [
        Candidate(s, float(np.log(listed * plain[s])), float(np.log(listed * learned[s])))
        for s in sets
    ]
    other = float(np.log(changed * UNLISTED_SHARE))
    return (*out, Candidate((), other, other, is_unlisted=True))
