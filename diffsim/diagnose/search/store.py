"""Simulations and fits on disk: an interrupted diagnosis goes on where it was, to the last bit."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from io import BytesIO
from pathlib import Path
from typing import Any, cast
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from diffsim.core.files import code_digest, write_bytes_atomic
from diffsim.core.record import Ended
from diffsim.data.study import Study
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Fit, Problem
from diffsim.identify.fitting import summary
from diffsim.identify.linearization import Linearization
from diffsim.identify.model import SimModel, Tally

Array = NDArray[np.float64]
Arrays = dict[str, NDArray[Any]]
WORK = "work"  # what an entry's simulations were counted as


def packed(at: Linearization) -> Arrays:
    """A linearization as arrays."""
    return {
        "x": at.x,
        "record": at.record,
        "idx": np.array(at.idx, dtype=np.int64),
        "columns": at.columns,
        "slope_error": np.array(at.slope_error),
    }


def unpacked(kept: Arrays) -> Linearization:
    """The linearization that was packed."""
    idx, error = tuple(int(i) for i in kept["idx"]), float(kept["slope_error"])
    return Linearization(kept["x"], kept["record"], idx, kept["columns"], error)


class Store:
    """Files of one study, model and set of candidates in a folder.

    Of a model made in Python, its name stands for its code: empty the folder after changing that.

    Args:
        folder: Shared by any number of studies.
        key: Identifier of study, model and candidates, as ``key_of`` makes it.
        tally: Counts what is simulated, and what earlier processes have simulated for what is read
            back: budgets end at the same place.
    """

    def __init__(self, folder: str | Path, key: str, tally: Tally):
        self.folder, self.tally = Path(folder) / key, tally

    def sibling(self, label: str) -> Store:
        """Files of the same, simulated another way."""
        return Store(self.folder.parent, f"{self.folder.name}-{label}", self.tally)

    def remembered(self, name: str, make: Callable[[], Arrays]) -> Arrays:
        """Arrays by name, from an earlier process or made and written now.

        Args:
            name: Says what they are, within this store.
            make: Simulates them.
        """
        kept = self.load_arrays(name)
        if kept is not None:
            self.tally.add(*(int(n) for n in kept.pop(WORK)))
            return kept
        before = self.tally.work
        made = make()
        self.save_arrays(name, **made, **{WORK: np.array(self.tally.since(before))})
        return made

    def save_arrays(self, name: str, **arrays: NDArray[Any]) -> None:
        """Write arrays of numbers, truth values or text to the folder."""
        buffer = BytesIO()
        np.savez(buffer, **arrays)  # type: ignore[arg-type]
        write_bytes_atomic(self._path(name), buffer.getvalue())

    def load_arrays(self, name: str) -> dict[str, NDArray[Any]] | None:
        """Arrays by name; None if there are none that can be read."""
        try:
            with np.load(self._path(name)) as file:
                return dict(file)
        except (FileNotFoundError, ValueError, BadZipFile):  # not there, or not whole
            return None

    def _path(self, name: str) -> Path:
        return self.folder / f"{hashlib.sha256(name.encode()).hexdigest()[:24]}.npz"


def key_of(study: Study, model: SimModel, *settings: object) -> str:
    """Hash of recordings, model name, its parameters, this package's code, and whatever else
    changes a simulation."""
    digest = hashlib.sha256(code_digest().encode())
    for part in _parts(study, model, settings):
        digest.update(part if isinstance(part, bytes) else repr(part).encode())
    return digest.hexdigest()[:24]


def _parts(study: Study, model: SimModel, settings: Iterable[object]) -> Iterable[object]:
    yield study.name, study.system, study.channels, dict(study.metadata)
    for run in study.runs:
        yield run.name, run.group, run.order, run.use, dict(run.setup), run.measured.shape
        yield run.time_s.tobytes()
        yield run.measured.tobytes()
        for name, values in run.command.items():
            yield name
            yield np.asarray(values).tobytes()
    yield model.name, model.base
    yield from settings


def gauss_newton_kept(
    store: Store, problem: Problem, start: Linearization, best_cost: float, until: float = np.inf
) -> tuple[Fit, Linearization]:
    """``gauss_newton``, read back where an earlier process ended the same fit.

    A finished fit does not serve as the start of itself: its trust region would be another one,
    and the resumed search would end elsewhere within the tolerance.

    Args:
        store: Fits of this study, model and set of candidates.
        problem: Fitting problem that is minimized.
        start: Start point, with the slopes of all coordinates.
        best_cost: As of ``gauss_newton`` [nats].
        until: As of ``gauss_newton``.
    """

    def ended() -> Arrays:
        fit, at = gauss_newton(problem, start, best_cost=best_cost, until=until)
        return {
            **packed(at),
            "residual": fit.residual,
            "jacobian": fit.jacobian,
            "ended": np.array(fit.ended),
            "message": np.array(fit.message),
            "evaluations": np.array(fit.num_evaluations),
        }

    kept = store.remembered(f"ended fit {_digest(problem, start, best_cost)}", ended)
    at = unpacked(kept)
    fit = summary(
        problem,
        at.x,
        kept["residual"],
        kept["jacobian"],
        cast(Ended, str(kept["ended"])),
        str(kept["message"]),
        int(kept["evaluations"]),
    )
    return fit, at


def _digest(problem: Problem, start: Linearization, best_cost: float) -> str:
    """Of all that decides where a fit ends; the noise floor shows in the whitened residual."""
    residual = problem.residual_of(start.record)
    digest = hashlib.sha256(repr((problem.names, best_cost, start.slope_error)).encode())
    for array in (start.x, start.record, start.slopes(range(len(start.x))), residual):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
