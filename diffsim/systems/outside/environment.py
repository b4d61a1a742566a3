"""Simulators with ``reset`` and ``step``, as Gymnasium has them, read as predictions of a run."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.data.study import Run

_ENTRY = re.compile(r"(.+)\[(\d+)\]")


@checked(kinds_only=True)
@dataclass(frozen=True)
class Environment:
    """How a simulator with ``reset`` and ``step`` is read; see ``SteppedSimulator``.

    Attributes:
        time_step: Time between two steps [s]; None: the environment's own ``dt``.
        observation: Entry of the observation that each channel shows; empty: in their order.
        action: Commands that make the action, in order; empty: all.
    """

    time_step: float | None = None
    observation: tuple[int, ...] = ()
    action: tuple[str, ...] = ()


class SteppedSimulator:
    """An environment that is stepped through a run under the run's commands.

    Parameters are attributes of the environment by their path, "mass" or "model.damping"; with an
    index, "state[0]", entries of what is there. They are set before ``reset``, and those of a start
    once more after it, as ``reset`` overwrites states.

    Args:
        environment: Object with ``reset`` and ``step``; wrappers around it are taken off.
        reading: Time step, entries of the observation, commands of the action.
    """

    def __init__(self, environment: Any, reading: Environment):
        self.environment = getattr(environment, "unwrapped", environment)
        self.reading = reading
        step = reading.time_step or getattr(self.environment, "dt", None)
        if not isinstance(step, (int, float)) or not step > 0.0:
            raise ValueError(
                f"environment {type(self.environment).__name__} has no attribute dt; state "
                "environment.time_step [s]"
            )
        self.step = float(step)

    def predict(self, parameters: Mapping[str, float], run: Run) -> Array:
        """(num_samples, num_channels); straight lines between the steps.

        Args:
            parameters: Values by path of the attribute.
            run: Run whose commands are the actions.
        """
        entries = {name: value for name, value in parameters.items() if _ENTRY.fullmatch(name)}
        for name, value in parameters.items():
            if name not in entries:
                put(self.environment, name, value)
        seen = _copy_observation(self.environment.reset(seed=0))
        for name, value in entries.items():
            put(self.environment, name, value)
        # a start that was set behind the back of ``reset`` is not in what it returned
        first = self._read_start(seen, entries)
        time = run.time_s - run.time_s[0]
        count = int(np.ceil(time[-1] / self.step - 1e-9))
        steps = self.step * np.arange(count + 1)
        actions = self._list_actions(run, steps + run.time_s[0])
        rows = []
        for action in actions[:-1]:
            rows.append(_copy_observation(self.environment.step(action)))
        width = run.measured.shape[1]
        picked = list(self.reading.observation) or list(range(width))
        seen_all = np.asarray([first, *rows], dtype=np.float64)[:, picked]
        return np.column_stack([np.interp(time, steps, column) for column in seen_all.T])

    def _list_actions(self, run: Run, times: Array) -> list[Any]:
        """The commands held from sample to sample, in the form of the action space."""
        names = self.reading.action or tuple(run.command)
        columns = [run.command[name] for name in names]
        if not columns:
            return [None] * len(times)
        at = np.clip(np.searchsorted(run.time_s, times + 1e-9, side="right") - 1, 0, None)
        values = np.column_stack(columns)[at]
        space = getattr(self.environment, "action_space", None)
        if space is not None and getattr(space, "shape", None) == ():
            return [round(float(v[0])) for v in values]
        dtype = getattr(space, "dtype", None) or np.float64
        return list(values.astype(dtype))

    def _read_start(self, seen: Array, entries: Mapping[str, float]) -> Array:
        observe = getattr(self.environment, "_get_obs", None)
        if entries and callable(observe):
            return np.array(observe(), dtype=np.float64)
        state = np.array(getattr(self.environment, "state", ()), dtype=np.float64)
        return state if entries and state.shape == seen.shape else seen


def put(target: Any, path: str, value: float) -> None:
    """Set an attribute, or an entry of one, by its path: "mass", "model.mass[2]", "state[0]".

    Raises:
        ValueError: there is no such attribute.
    """
    entry = _ENTRY.fullmatch(path)
    *steps, last = (entry[1] if entry else path).split(".")
    for name in steps:
        target = _find_attribute(target, name, path)
    if entry is None:
        _find_attribute(target, last, path)
        setattr(target, last, value)
        return
    values = np.array(_find_attribute(target, last, path), dtype=np.float64)
    values.reshape(-1)[int(entry[2])] = value
    held = getattr(target, last)
    if isinstance(held, np.ndarray):
        held[...] = values
    else:
        setattr(target, last, values)


def _find_attribute(target: Any, name: str, path: str) -> Any:
    if not hasattr(target, name):
        raise ValueError(f"{type(target).__name__} has no attribute {name!r} for parameter {path}")
    return getattr(target, name)


def _copy_observation(given: Any) -> Array:
    seen = given[0] if isinstance(given, tuple) else given
    return np.array(seen, dtype=np.float64)  # a copy: environments step their states in place
