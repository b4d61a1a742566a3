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
from diffsim.diagnose.store import Store
from diffsim.identify import Problem
from diffsim.identify.local import Local, local_at, measured_of, record_at, whitened
from diffsim.identify.unknown import Unknown, by_group

Array = NDArray[np.float64]
Members = frozenset[int]
NOTICED = 1.0  # z above which an effect is differentiated again at a new centre
ALIKE = 0.9  # cosine with a member above which it is, too


class Points:
    """What was simulated.

    Args:
        wide: Problem with all candidate effects.
        before: Of an earlier round with the same model and runs: nothing is simulated twice.
        store: On disk, of an earlier process.
    """

    def __init__(self, wide: Problem, before: Points | None = None, store: Store | None = None):
        self.wide = wide
        self.store: Store | None = before.store if before and store is None else store
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
        if self.store is not None and members:
            self.store.save(f"fitted {self._label(members)}", self.fitted[members])

    def known(self, members: Members) -> Local | None:
        """The fit of a set, from this process or an earlier one."""
        if members not in self.fitted and self.store is not None:
            found = self.store.load(f"fitted {self._label(members)}")
            if found is not None:
                self.fitted[members] = found
        return self.fitted.get(members)

    def _label(self, members: Members) -> str:
        return " + ".join(self.wide.effects[i].name for i in sorted(members))

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
        if (before := self.known(members)) is not None:
            return before
        own = self.coordinates(members)
        outside = np.ones(len(centre.x), dtype=bool)
        outside[own] = False
        if not centre.x[outside].any():
            return centre
        narrow = self.narrow(members)
        x = x.copy()
        x[own] = np.clip(x[own], *narrow.bounds)  # a linear answer knows no bounds
        record = record_at(narrow, x[own])
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
        here, label = self.fitted[members], f"screened {self._label(members)}"
        before = self.screened.get(members)
        if before is None and self.store is not None:
            before = self.store.load(label)
        if before is not None:
            self.screened[members] = before
            return here.joined(before)
        if last is None:
            others = [i for i in range(len(here.x)) if i not in here.idx]
            here = here.joined(local_at(self.wide, here.x, others, screen=True))
        else:
            anew = [i for i in self._noticed(here.joined(last)) if i not in here.idx]
            if anew:
                here = here.joined(local_at(self.wide, here.x, anew, screen=True))
            here = here.joined(last)
        self.screened[members] = here
        if self.store is not None:
            self.store.save(label, here)
        return here

    def linear(
        self,
        members: Members,
        local: Local,
        unknowns: Sequence[Unknown],
        num_families: int,
    ) -> Linearisation:
        """Everything at a point; unknown causes simulated at most once per set."""
        blocks = [self.responses(u, i, members, local) for i, u in enumerate(unknowns)]
        wide = self.wide
        residual = whitened(wide, measured_of(wide) - local.record)
        jacobian = whitened(wide, local.slopes(range(len(local.x))))
        return Linearisation(wide, local.x, residual, jacobian, blocks, num_families)

    def responses(self, unknown: Unknown, u: int, members: Members, local: Local) -> Array:
        """Whitened responses of an unknown cause, number ``u``, at a set."""
        if (members, u) not in self.forces:
            self.forces[members, u] = self._slopes_of(unknown, members, local)
        return by_group(self.wide, unknown.mix(self.forces[members, u]))

    def _slopes_of(self, unknown: Unknown, members: Members, local: Local) -> Array:
        label = f"{unknown.name} at {self._label(members)}"
        if self.store is not None and (found := self.store.load_array(label)) is not None:
            return found
        slopes = unknown.slopes(self.narrow(members), local.x[self.coordinates(members)])
        if self.store is not None:
            self.store.save_array(label, slopes)
        return slopes

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
