"""What is fitted to a run whatever it is used for: values that are its own ("offset@run")."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Protocol
from weakref import WeakKeyDictionary, ref

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from diffsim.data.study import Run
from diffsim.identify import Problem
from diffsim.identify.effort import FIT_RTOL

Array = NDArray[np.float64]
_FAR = 1.5  # misfit per sample of a run's own values, from which their slopes are taken anew
_STRAIGHT = 0.02  # share of it that this must promise
_MAX_STEPS = 20
_Asked = tuple[int, bytes, tuple[str, ...]]


class Frozen(Protocol):
    """A problem at coordinates that are not fitted any more; a ``Fit`` is one."""

    @property
    def problem(self) -> Problem: ...

    @property
    def x(self) -> Array: ...


# a run's own values are asked for by the gain, the errors, the page and the recording
_FOUND: WeakKeyDictionary[Problem, dict[_Asked, tuple[ref[Run], Array]]] = WeakKeyDictionary()


def held_out_point(fit: Frozen, run: Run, unmet: Collection[str] | None = None) -> Array:
    """A fit's coordinates with what is a run's own ("offset@run") fitted to it, (n,).

    Remembered as long as the problem and the run live: nothing is simulated twice.

    Args:
        fit: Model, noise and coordinates, which stay.
        run: Run that was not fitted.
        unmet: Parameters that no fitted run has, as of ``own_names``; None: those of the problem.
    """
    known = tuple(unmet_by(fit.problem) if unmet is None else unmet)
    found = _FOUND.setdefault(fit.problem, {})
    asked = (id(run), np.asarray(fit.x).tobytes(), known)
    if asked in found and found[asked][0]() is run:
        return found[asked][1].copy()
    point = own_point(replace(fit.problem, runs=(run,)), fit.x, run, unmet=known)
    found[asked] = ref(run), point
    return point.copy()


def unmet_by(problem: Problem) -> tuple[str, ...]:
    """Base parameters of a rotor, a material, ... that no run of the problem has."""
    known = {n for run in problem.runs for n in problem.names if is_of_fact(n, run)}
    return tuple(p.name for p in problem.model.base if "[" in p.name and p.name not in known)


def is_of_fact(name: str, run: Run) -> bool:
    """Whether a parameter, as "gain[rotor=A]", is that of a fact of the run."""
    return any(name.endswith(f"[{fact}={value}]") for fact, value in run.setup.items())


def own_names(names: Sequence[str], run: Run, unmet: Collection[str] = ()) -> tuple[str, ...]:
    """Parameters that are fitted to a run whatever it is used for.

    Args:
        names: Names of all coordinates.
        run: Run that they belong to.
        unmet: Parameters that no fitted run has; those of this run's facts are its own.
    """
    at_run = f"@{run.name}"
    return tuple(n for n in names if n.endswith(at_run) or (n in unmet and is_of_fact(n, run)))


def own_point(
    problem: Problem,
    x: Array,
    run: Run,
    slopes: Array | None = None,
    unmet: Collection[str] = (),
) -> Array:
    """Coordinates with the values of one run ("offset@run") fitted to it, all others as given.

    Args:
        problem: Model and noise, with this run only.
        x: Standardized coordinates, (n,); the run's own are fitted from the middle of their prior.
        run: Run that they belong to.
        slopes: Whitened slopes of the run's rows, (num_valid, n); None: simulated.
        unmet: Parameters that no fitted run has, as of ``own_names``.
    """
    names = set(own_names(problem.names, run, unmet))
    own = [i for i, n in enumerate(problem.names) if n in names]
    if not own:
        return x

    def full(part: Array) -> Array:
        point = x.copy()
        point[own] = part
        return point

    @lru_cache(maxsize=1)  # where slopes of before are given up, they are asked for twice
    def columns_of(key: bytes) -> Array:
        part = np.frombuffer(key, dtype=np.float64)
        return -np.asarray(problem.linearize(full(part), only=own)[1][:, own])

    def columns_at(part: Array) -> Array:
        return columns_of(part.tobytes())

    # what is stated per run acts almost linearly: slopes of its start serve for all steps; a size
    # is no straight function of its coordinate
    is_linear = not names & set(unmet) and max(own) < problem.num_base
    start = np.zeros(len(own))
    columns = columns_at(start) if slopes is None or not is_linear else -slopes[:, own]
    low, high = (b[own] for b in problem.bounds)

    def best_from(part: Array, held: Array | None) -> Array:
        slopes_at = columns_at if held is None else lambda _: held
        found: Array = optimize.least_squares(
            lambda part: np.concatenate([problem.residual(full(part)), part]),
            np.clip(part, low, high),
            jac=lambda part: np.vstack([slopes_at(part), np.eye(len(own))]),
            bounds=(low, high),
            method="trf" if not (np.isfinite(low).any() or np.isfinite(high).any()) else "dogbox",
            ftol=FIT_RTOL,
            max_nfev=_MAX_STEPS,
        ).x
        return found

    part = best_from(start, columns if is_linear else None)
    if is_linear and slopes is None:
        left = problem.residual(full(part))
        if left @ left > _FAR * len(left) and _promise(left, columns_at(part), part) > _STRAIGHT:
            part = best_from(part, None)  # a ball that begins to roll: no straight function
    return full(part)


def _promise(left: Array, columns: Array, part: Array) -> float:
    """Share of the misfit that another step would remove, were all straight."""
    rest, slopes = np.concatenate([left, part]), np.vstack([columns, np.eye(len(part))])
    step = np.linalg.lstsq(slopes, -rest, rcond=None)[0]
    after = rest + slopes @ step
    return 1.0 - float(after @ after) / float(rest @ rest)
