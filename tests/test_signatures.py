"""Every public callable, argument by argument: a thing that is none is refused by its name.

What is public is found as ``scripts/api_page.py`` finds it. Right arguments, which other tests
spoil in more ways, have those of ``tests.derivatives`` and ``tests.fuzz_entries``; all others are
asked here by one argument alone, or stand in ``ELSEWHERE`` with the reason.
"""

from __future__ import annotations  # ``checked`` reads them as text

import importlib
import inspect
import re
from collections.abc import Callable, Iterator
from io import StringIO
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

from diffsim.core.arrays import Array
from diffsim.core.checked import checked, checked_methods
from diffsim.core.errors import DiffsimError
from diffsim.data.study import Run
from diffsim.diagnose import Interval
from diffsim.optim import minimize
from tests.derivatives.examples import MAKE
from tests.derivatives.public import CALLED, load_api_page
from tests.fuzz_entries import ENTRIES
from tests.test_arguments import CHECKED, RAW, Thing

ELSEWHERE = {
    "made and called by a model, at each run that it simulates": [
        r"^identify\.Effect\.act$",
        r"^(causes|systems\.\w+)\.\w*Scene\.(?!with_[acfhpns]|find|deliv|simulate)",
        r"^systems\.outside\.PlaceForces\.",
        r"^causes\.(OwnRow|Plant)\.",
    ],
    "called at each step of a flight, with the state that the simulator has made": [
        r"simulator\.(FlightSimulator\.step|\w+Controller\.thrusts|Ground\.hold|Pacer\.wait)$",
        r"simulator\.(Leg|Mission|\w+Sticks|StickPilot)\.[a-z]",
    ],
    "called by Gymnasium and by learners, with what a space or a learner has made": [
        r"^envs\.(Sb3VecEnv\.[a-z]|Task\.(picture|step)|Task\w*Env\.\w*step$)",
    ],
    "made by a diagnosis alone; of parts of it pages are written, too": [
        r"^diagnose\.Report\.__init__$",
    ],
    "abstract, or of points that are checked already": [
        r"^(contact\.(Shape|Box)|control\.OpenLoop)\.(__init__|evaluate|signal)$",
        r"^stokes\.shapes\.\w+\.level$",
    ],
    "its tensors are checked by what reads it": [
        r"^(mesh\.(ShapeGradients|Surface)|soft\.Physics|copter\.Fleet)\.(__init__|damping)$",
        r"^systems\.robots\.SoftRobot\.[a-z]",
    ],
    "hands on what programs gave it; tests/core and tests/cli": [r"^core\.|^cli\.main$"],
}
"""Patterns of callables that are not asked here, by the reason."""
LEFT_OUT = [pattern for patterns in ELSEWHERE.values() for pattern in patterns]
ANYTHING = {
    *("Source.given", "outside_setup.simulator"),  # any simulator
    *("PrintedPart.mesh", "SurfaceDistance.surface", "tetrahedralize.surface", "voxelize.surface"),
    *("Fit.jacobian", "fit.model", "fit.numerics"),
    *("NumericalEffect.apply", "NumericalEffect.locate", "NumericalEffect.needs"),
    *(f"{name}.run" for name in ("cost", "scene", "shape_at", "shape_of", "num_fitted_inside")),
    *(f"{name}.run" for name in ("predict", "predict_many", "simulate_many", "tangents")),
    *("note_derivatives.run", "note_simulations.run"),  # a model's own kind of run
    *("tangents.at", "find_file.stated"),
}
"""Arguments of any kind, or of classes that are known to a type checker alone."""


class Public(NamedTuple):
    """A callable."""

    name: str  # room and name, such as "data.Run.part"
    called: Callable[..., Any]  # what is called
    first: tuple[Any, ...]  # what goes before the named arguments: an object's place in a method

    def arguments(self) -> list[str]:
        """Names of arguments that may be given by name."""
        named = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
        given = list(inspect.signature(self.called).parameters.values())[len(self.first) :]
        return [p.name for p in given if p.kind in named]


def public() -> dict[Any, Public]:
    """All that is public and can be called, each once: by what it is."""
    found: dict[Any, Public] = {}
    for package in load_api_page().packages():
        room = importlib.import_module(package)
        for name in sorted(room.__all__):
            for key, one in _of(f"{package.removeprefix('diffsim.')}.{name}", getattr(room, name)):
                found.setdefault(key, one)
    return found


def _of(name: str, thing: Any) -> Iterator[tuple[Any, Public]]:
    if not inspect.isclass(thing):
        if inspect.isroutine(thing):
            yield thing, Public(name, thing, ())
        return
    is_plain = issubclass(thing, BaseException) or getattr(thing, "_is_protocol", False)
    if is_plain or hasattr(thing, "_fields") or not thing.__module__.startswith("diffsim"):
        return  # a named tuple keeps what it is given: it is read by what takes it
    if not hasattr(thing, "model_fields"):  # else pydantic refuses by key
        yield thing, Public(f"{name}.__init__", thing, ())
    for method, function in inspect.getmembers(thing, inspect.isroutine):
        is_own = str(getattr(function, "__module__", "")).startswith("diffsim")
        is_shown = not method.startswith("_") or method in CALLED
        if is_own and is_shown and not getattr(function, "__isabstractmethod__", False):
            static = isinstance(inspect.getattr_static(thing, method), staticmethod)
            first = () if static or inspect.ismethod(function) else (None,)
            key = getattr(function, "__func__", function)
            yield key, Public(f"{name}.{method}", function, first)


def asked() -> list[Public]:
    """What has no right arguments in a table, and no reason to be left out."""
    spoiled = {one.function for one in CHECKED} | set(MAKE)
    return [
        one
        for key, one in public().items()
        if key not in spoiled and one.name not in ENTRIES and one.arguments()
        if not any(re.search(pattern, one.name) for pattern in LEFT_OUT)
    ]


def complaint(one: Public, argument: str) -> str:
    """What is wrong with the answer to one argument that is nothing of its kind; empty: nothing."""
    try:
        one.called(*one.first, **{argument: Thing()})
    except (TypeError, ValueError, DiffsimError) as error:
        said = str(error)
        is_named = re.search(rf"\b{argument}\b", said) and "missing" not in said
        return "" if is_named and not RAW.search(said) else f"unclear: {error!r}"
    except Exception as error:
        return f"raw: {error!r}"
    return "silent"


def test_a_thing_is_refused_by_the_name_of_its_argument():
    wrong = [
        f"{one.name} {argument}: {said}"
        for one in asked()
        for argument in one.arguments()
        if f"{one.name.removesuffix('.__init__').rpartition('.')[2]}.{argument}" not in ANYTHING
        if (said := complaint(one, argument))
    ]
    assert not wrong, "\n" + "\n".join(wrong)


def test_most_is_asked_and_each_reason_is_of_something():
    everything = list(public().values())
    for pattern in LEFT_OUT:
        assert any(re.search(pattern, one.name) for one in everything), pattern
    left_out = [one for one in everything if any(re.search(p, one.name) for p in LEFT_OUT)]
    assert len(asked()) > 400 and len(left_out) < 130


class Reader(Protocol):
    """What has a method."""

    def read(self) -> str: ...


@checked
def taking(
    reader: Reader | None = None,
    rows: Array | None = None,
    way: Literal["up", "down"] = "up",
    number: float = 0.0,
    count: int = 1,
) -> None:
    """Nothing."""


def test_kinds_of_annotations():
    taking(StringIO(), np.ones(2), "down", np.float32(1.0), np.int64(2))
    taking(rows=[1.0, 2.0])
    for name, bad, said in (
        ("reader", Thing(), "reader must be a Reader"),
        ("rows", 1.0, "rows must be an array"),
        ("way", None, "way must be one of the words"),
        ("number", np.nan, "number must be a number, got nan"),
        ("count", 2.0, "count must be a whole number"),
    ):
        with pytest.raises((TypeError, ValueError), match=said):
            taking(**{name: bad})


def test_records_of_results_may_say_that_there_is_no_number():
    assert np.isnan(Interval(np.nan, -np.inf, np.inf).value)
    with pytest.raises(TypeError, match="low must be a number, got str"):
        Interval(0.0, "low", 1.0)
    with pytest.raises(TypeError, match="measured must be an array"):
        Run("a", np.arange(3.0), [[0.0]] * 3, {}, "a")


def test_lists_of_numbers_are_arrays_where_something_is_computed():
    found = minimize(lambda x: (float(x @ x), 2.0 * x), [3, 4])
    np.testing.assert_allclose(found.final.x, 0.0, atol=1e-6)


@checked_methods
class Kept:
    """Public methods are checked, private ones are not."""

    def times(self, count: int) -> int:
        return 2 * self._times(count)

    def _times(self, count: int) -> int:
        return count


def test_public_methods_of_a_class_are_checked_and_private_ones_are_not():
    assert Kept().times(2) == 4
    with pytest.raises(TypeError, match="count must be a whole number"):
        Kept().times("2")  # type: ignore[arg-type]
    assert Kept()._times("2") == "2"  # type: ignore[arg-type]
