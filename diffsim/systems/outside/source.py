"""Where a user's simulator comes from, and what it can do: found out once, said where it is not."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

from diffsim.core.check import did_you_mean
from diffsim.core.checked import checked
from diffsim.core.inside import inside
from diffsim.data.study import Run
from diffsim.systems.outside.environment import Environment, SteppedSimulator
from diffsim.systems.outside.forces import PlaceForces

MJCF = "diffsim.systems.outside.mjcf:Mjcf"
BY_NAME = ("delays", "before")  # one that takes anything would drop them
OFFERS = ("force", "time_step", *BY_NAME)


@dataclass(frozen=True, eq=False)
class Call:
    """One call of a simulator that takes several at once (``predict_many``)."""

    parameters: Mapping[str, float]  # values by name
    run: Run  # run with the commands as the actuators hear them
    force: PlaceForces | None = None  # forces that it is asked to add; None: none
    time_step: float = 1.0  # factor on its own step
    # time by which it hears a command late, by name [s]
    delays: Mapping[str, float] = field(default_factory=dict)
    # values of such commands before the run; without a word their first ones
    before: Mapping[str, float] = field(default_factory=dict)


Predict = Callable[..., Any]
"""A simulator, called as predict(parameters, run, **offers).

It gets the values of parameters and start by name, and the run: its times, its commands as the
actuators hear them, its known facts (``setup``). It returns the channels, (num_samples,
num_channels), or a mapping of channels by name. What it takes beside these it offers: ``force``, a
function (time, positions, velocities) -> forces at the places; ``time_step``, a factor on its own
step; ``delays``, by which it hears commands late between samples, too, in seconds by name;
``before``, what such commands were before the run, by name.
"""


PredictMany = Callable[[Sequence[Call], int], list[Any]]
"""Several calls at once, on so many threads of its own: channels or the error of each."""


@checked(kinds_only=True)
@dataclass(frozen=True)
class Source:
    """A simulator by its place: "my_sim.py:Simulator", "package.module:name" or "gym:Pendulum-v1".

    Attributes:
        place: File or module, a colon, and the name in it.
        folder: Folder that files are relative to; None: the working folder.
        options: Keyword arguments of the class, or of the function that makes the simulator.
        environment: How ``reset`` and ``step`` are read, where the simulator has these.
        given: The simulator itself, where Python gives it instead of a place.
    """

    place: str
    folder: Path | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    environment: Environment = field(default_factory=Environment)
    given: Any = None

    def problem(self) -> str | None:
        """What is wrong with the place, found without running the user's code."""
        if self.given is not None or self.place.startswith("gym:"):
            return None
        where, colon, name = self.place.rpartition(":")
        if not colon or not where or not name:
            return (
                f"simulator must read FILE.py:NAME, MODULE:NAME or gym:ID, got {self.place!r}; "
                "NAME is a class with predict(parameters, run), or such a function"
            )
        if where.endswith(".py") and not (path := self._find_path(where)).is_file():
            return f"simulator: no file {path}"
        return None

    @property
    def label(self) -> str:
        """Place and, where it is a file, a hash of its content: a changed file is another model; of
        an MJCF the name of its file."""
        file = str(self.options.get("model", ""))
        if self.place == MJCF and not file.lstrip().startswith("<"):
            return f"{Path(file).name} in MuJoCo"
        where = self.place.rpartition(":")[0]
        if self.given is not None or not where.endswith(".py"):
            return self.place
        content = hashlib.sha256(self._find_path(where).read_bytes()).hexdigest()[:8]
        return f"{self.place} ({content})"

    def make(self) -> Predict:
        """The simulator as a function.

        Raises:
            ValueError: it cannot be found or made, or has neither ``predict`` nor ``reset`` and
                ``step``.
        """
        if problem := self.problem():
            raise ValueError(problem)
        made = self._make_simulator()
        if predict := getattr(made, "predict", None):
            return self._check_predict(predict)
        if hasattr(made, "reset") and hasattr(made, "step"):
            return SteppedSimulator(made, self.environment).predict
        if callable(made):
            return self._check_predict(made)
        raise ValueError(
            f"simulator {self.place} must be a function predict(parameters, run), or an object "
            f"with predict, or with reset and step; got {type(made).__name__}"
        )

    def _make_simulator(self) -> Any:
        if self.given is not None:
            return self.given
        if self.place.startswith("gym:"):
            return _make_gym_environment(self.place[4:], self.options)
        where, _, name = self.place.rpartition(":")
        module = self._import_module(where)
        found = getattr(module, name, None)
        if found is None:
            known = [n for n in vars(module) if not n.startswith("_")]
            raise ValueError(f"simulator: {where} has no {name!r}{did_you_mean(name, known)}")
        if not isinstance(found, type) and not self.options:
            return found
        try:
            return found(**self.options)
        except Exception as error:
            raise ValueError(
                f"simulator {self.place} cannot be made from options {dict(self.options)}: "
                f"{type(error).__name__}: {error}"
            ) from error

    def _import_module(self, where: str) -> ModuleType:
        try:
            if not where.endswith(".py"):
                return importlib.import_module(where)
            path = self._find_path(where)
            spec = importlib.util.spec_from_file_location(path.stem, path)
            if spec is None or spec.loader is None:
                raise ImportError(f"{path} is no Python file")
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            return module
        except Exception as error:
            raise ValueError(
                f"simulator: {where} cannot be imported: {type(error).__name__}: {error}"
            ) from error

    def _find_path(self, where: str) -> Path:
        return inside(self.folder or Path(), where, "simulator")

    def _check_predict(self, predict: Callable[..., Any]) -> Predict:
        """The function, after a look at its signature."""
        try:
            inspect.signature(predict).bind({}, None, **dict.fromkeys(offers_of(predict)))
        except TypeError as error:
            raise ValueError(
                f"simulator {self.place}: predict must take (parameters, run): {error}"
            ) from None
        return predict


def offers_of(predict: Callable[..., Any]) -> frozenset[str]:
    """Which of ``OFFERS`` a simulator takes as keyword arguments."""
    known = inspect.signature(predict).parameters.values()
    found = frozenset(p.name for p in known) & frozenset(OFFERS)
    takes_any = any(p.kind is p.VAR_KEYWORD for p in known)
    return found | (frozenset(OFFERS) - frozenset(BY_NAME)) if takes_any else found


def _make_gym_environment(name: str, options: Mapping[str, Any]) -> Any:
    try:
        import gymnasium

        return gymnasium.make(name, **options)
    except Exception as error:
        raise ValueError(
            f"simulator gym:{name} cannot be made: {type(error).__name__}: {error}"
        ) from error
