"""Points where a set of effects was fitted, with what was simulated there, kept between rounds.

Coordinates are those of the wide problem, with all candidates: base parameters, then components of
all effects, zero for those not in the set.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from diffsim.diagnose.descend import Descended, descend
from diffsim.diagnose.evidence import Linearisation
from diffsim.diagnose.local import Local, local_at, measured_of, record_at, whitened
from diffsim.diagnose.unknown import Unknown, by_group
from diffsim.identify import Problem

Array = NDArray[np.float64]
Members = frozenset[int]
NOTICED = 1.0  # z above which an effect is differentiated again at a new centre
ALIKE = 0.9  # cosine with a member above which it is, too


class Points:
    """What was simulated.

    Args:
        wide: Problem with all candidate effects.
        before: Of an earlier round with the same model and runs: nothing is simulated twice.
    """

    def __init__(self, wide: Problem, before: Points | None = None):
        self.wide = wide
        self.fitted: dict[Members, Local] = dict(before.fitted) if before else {}
        self.screened: dict[Members, Local] = dict(before.screened) if before else {}
        self.forces: dict[tuple[Members, int], Array] = dict(before.forces) if before else {}

    def coordinates(self, members: Members) -> list[int]:
        """Of the base parameters and of a set."""
        own = list(range(self.wide.num_base))
        for i in sorted(members):
            own += self.wide.columns_of(self.wide.effects[i])
        return own

    def narrow(self, members: Members) -> Problem:
        """Problem with the effects of a set only."""
        return replace(self.wide, effects=tuple(self.wide.effects[i] for i in sorted(members)))

    def keep(self, members: Members, local: Local) -> None:
        """Remember a point in the coordinates of ``narrow``."""
        own = self.coordinates(members)
        x = np.zeros(len(self.wide.names))
        x[own] = local.x
        self.fitted[members] = replace(local, x=x, idx=tuple(own))

    def descend(self, members: Members, start: Local, ahead: Callable[[], float]) -> Descended:
        """Fit a set.

        Args:
            members: The set.
            start: In wide coordinates, zero outside the set.
            ahead: As for ``descend``.
        """
        own = self.coordinates(members)
        local = Local(
            start.x[own], start.record, tuple(range(len(own))), start.slopes(own), start.stray
        )
        found = descend(self.narrow(members), local, ahead=ahead)
        self.keep(members, found.local)
        return found

    def start(self, members: Members, centre: Local, x: Array) -> Local:
        """Where to begin with a set: an earlier fit of it, the centre itself where the set only
        adds to it, else the linear answer ``x`` with the centre's slopes."""
        if members in self.fitted:
            return self.fitted[members]
        own = self.coordinates(members)
        outside = np.ones(len(centre.x), dtype=bool)
        outside[own] = False
        if not centre.x[outside].any():
            return centre
        record = record_at(self.narrow(members), x[own])
        step = x - centre.x
        said = centre.slopes(range(len(x))) @ step
        off = linalg.norm(whitened(self.wide, record - centre.record - said))
        moved = linalg.norm(whitened(self.wide, said))
        return replace(centre, x=x, record=record, stray=float(off / max(moved, 1.0)))

    def screen(self, members: Members, last: Local | None) -> Local:
        """All slopes at the fit of a set.

        Args:
            members: Fitted before.
            last: Of the set before: its slopes serve for effects that are neither noticed with them
                nor like a member; None: all are simulated.
        """
        here = self.fitted[members]
        if members in self.screened:
            here = here.joined(self.screened[members])
        elif last is None:
            others = [i for i in range(len(here.x)) if i not in here.idx]
            here = here.joined(local_at(self.wide, here.x, others, screen=True))
        else:
            anew = [i for i in self._noticed(here.joined(last)) if i not in here.idx]
            if anew:
                here = here.joined(local_at(self.wide, here.x, anew, screen=True))
            here = here.joined(last)
        self.screened[members] = here
        return here

    def linear(
        self,
        members: Members,
        local: Local,
        unknowns: Sequence[Unknown],
        num_families: int,
    ) -> Linearisation:
        """Everything at a point; unknown causes simulated at most once per set."""
        blocks = []
        for u, unknown in enumerate(unknowns):
            if (members, u) not in self.forces:
                problem = self.narrow(members)
                x = local.x[self.coordinates(members)]
                self.forces[members, u] = unknown.slopes(problem, x)
            blocks.append(by_group(self.wide, self.forces[members, u]))
        wide = self.wide
        residual = whitened(wide, measured_of(wide) - local.record)
        jacobian = whitened(wide, local.slopes(range(len(local.x))))
        return Linearisation(wide, local.x, residual, jacobian, blocks, num_families)

    def _noticed(self, local: Local) -> list[int]:
        """Coordinates of effects that stand out of the noise with borrowed slopes, or that are hard
        to tell from a member."""
        wide = self.wide
        own = [i for i in range(len(local.x)) if i < wide.num_base or local.x[i] != 0.0]
        residual = whitened(wide, measured_of(wide) - local.record)
        slopes = whitened(wide, local.slopes(range(len(local.x))))
        j = slopes[:, own]
        inner = linalg.inv(j.T @ j + np.eye(len(own)))
        tilde = slopes - j @ (inner @ (j.T @ slopes))
        information = np.clip(np.sum(slopes * tilde, axis=0), 1e-12, None)
        z = np.abs(slopes.T @ residual - (j.T @ slopes).T @ (inner @ (j.T @ residual)))
        z /= np.sqrt(information)
        members = slopes[:, [i for i in own if i >= wide.num_base]]
        lengths = np.outer(linalg.norm(slopes, axis=0), linalg.norm(members, axis=0))
        alike = np.any(np.abs(slopes.T @ members) > ALIKE * lengths, axis=1, keepdims=True)[:, 0]
        found: list[int] = []
        for effect in wide.effects:
            c = wide.columns_of(effect)
            if linalg.norm(z[c]) > NOTICED * np.sqrt(len(c)) or alike[c].any():
                found += c
        return found
