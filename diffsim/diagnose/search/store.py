"""Simulations and fits on disk: an interrupted diagnosis goes on where it was, to the last bit."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import Any, cast
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from diffsim.core.files import write_bytes_atomic
from diffsim.core.record import Ended
from diffsim.data.study import Study
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Fit, Problem
from diffsim.identify.fitting import summary
from diffsim.identify.linearization import Linearization, measured_of, whitened
from diffsim.identify.model import SimModel

Array = NDArray[np.float64]


class Store:
    """Files of one study, model and set of candidates in a folder.

    The name of the model stands for its code: empty the folder after changing that.

    Args:
        folder: Shared by any number of studies.
        key: Identifier of study, model and candidates, as ``key_of`` makes it.
    """

    def __init__(self, folder: str | Path, key: str):
        self.folder = Path(folder) / key

    def beside(self, label: str) -> Store:
        """Files of the same, simulated another way."""
        return Store(self.folder.parent, f"{self.folder.name}-{label}")

    def save(self, name: str, at: Linearization) -> None:
        """Write a linearization to the folder."""
        self.save_arrays(
            name,
            x=at.x,
            record=at.record,
            idx=np.array(at.idx, dtype=np.int64),
            columns=at.columns,
            slope_error=np.array(at.slope_error),
        )

    def load(self, name: str) -> Linearization | None:
        """A linearization; None if there is none that can be read."""
        kept = self.load_arrays(name)
        if kept is None:
            return None
        idx = tuple(int(i) for i in kept["idx"])
        error = float(kept["slope_error"])
        return Linearization(kept["x"], kept["record"], idx, kept["columns"], error)

    def save_array(self, name: str, array: Array) -> None:
        """Write an array to the folder."""
        self.save_arrays(name, array=array)

    def load_array(self, name: str) -> Array | None:
        """An array; None if there is none that can be read."""
        kept = self.load_arrays(name)
        return None if kept is None else kept["array"]

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
    """Hash of recordings, model name, its parameters, and whatever else changes a simulation."""
    digest = hashlib.sha256()
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
    store: Store, problem: Problem, start: Linearization, best_cost: float
) -> tuple[Fit, Linearization]:
    """``gauss_newton``, read back where an earlier process ended the same fit.

    A finished fit does not serve as the start of itself: its trust region would be another one,
    and the resumed search would end elsewhere within the tolerance.

    Args:
        store: Fits of this study, model and set of candidates.
        problem: Fitting problem that is minimized.
        start: Start point, with the slopes of all coordinates.
        best_cost: As of ``gauss_newton`` [nats].
    """
    name = f"ended fit {_digest(problem, start, best_cost)}"
    kept = store.load_arrays(name)
    if kept is None:
        fit, at = gauss_newton(problem, start, best_cost=best_cost)
        store.save_arrays(
            name,
            x=at.x,
            record=at.record,
            columns=at.columns,
            slope_error=np.array(at.slope_error),
            residual=fit.residual,
            jacobian=fit.jacobian,
            ended=np.array(fit.ended),
            message=np.array(fit.message),
            evaluations=np.array(fit.num_evaluations),
        )
        return fit, at
    coordinates = tuple(range(len(kept["x"])))
    at = Linearization(
        kept["x"], kept["record"], coordinates, kept["columns"], float(kept["slope_error"])
    )
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
    residual = whitened(problem, measured_of(problem) - start.record)
    digest = hashlib.sha256(repr((problem.names, best_cost, start.slope_error)).encode())
    for array in (start.x, start.record, start.slopes(range(len(start.x))), residual):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
