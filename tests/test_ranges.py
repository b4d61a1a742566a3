"""What a docstring says is out of an argument's range is refused by its name.

Ranges are read from the docstrings of all that is public ("> 0", ">= 0", "in [0, 1]"); right
arguments are those of ``tests.derivatives``, or the defaults. What refusals say of all other
arguments is a known number (``tests.known``).
"""

import importlib
import inspect
import math
import re
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest
from torch import Tensor

pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

from diffsim import soft
from diffsim.core.errors import DiffsimError
from tests.derivatives import models  # noqa: F401 fills the tables
from tests.derivatives.examples import ABSTRACT, CALL, FACTORIES, MAKE
from tests.derivatives.public import Public, load_api_page
from tests.test_arguments import IN_OTHER_WORDS
from tests.test_derivatives import PUBLIC, example_of, needs_example

pytestmark = pytest.mark.filterwarnings("ignore")
RANGE = re.compile(
    r"(?<![\w)|] )(?P<more>>=?) (?P<than>-?[\d.]+)\b"
    r"|\bin (?P<left>[\[(])(?P<low>-?[\d.]+), (?P<high>[\d.]+)(?P<right>[\])])"
)
TOLD = re.compile(
    r"must lie in (?P<left>[\[(])(?P<low>[^,]+), (?P<high>[^\])]+)(?P<right>[\])])"
    r"|must be a whole number >= (?P<least>\d+)"
)
FAR = (-1e3, 1e3)
ENTRY = re.compile(r"    (?P<names>[a-z]\w*(?:, [a-z]\w*)*): (?P<text>.*)")
OTHERWISE = {
    *("Plane.normal", "Rotate.axis"),  # its length is
    *("TetMesh.tets", "StokesFlow.phi", "cut_cells.phi"),  # volumes and the fluid are
    *("FlowField.phi", "StokesFlow.forward.phi", "Tendon.path", "codesign.objective"),
    *("Task.actions", "Task.observations", "Knots.start"),  # these are clipped
    "pareto_front.num_points",  # tests/copter/codesign/test_codesign_metrics.py
}
"""Arguments of which the docstring says "> 0" of something else."""


EXAMPLES: dict[str, Callable[[], dict[str, Any]]] = {
    "CurrentModel": lambda: {"scale": [0.3] * 4, "exponent": [1.4] * 4},
}
"""Right arguments of what takes no tensors."""
ASKED = {soft.Damping: lambda made: soft.SoftBody(**{**MAKE[soft.SoftBody](), "damping": made})}
"""What checks an object that is only kept."""


class Ranged(NamedTuple):
    """An argument with a range."""

    public: Public | None  # a method; None for a function or a class
    thing: Any  # function, or class
    name: str  # of the argument
    outside: tuple[float, ...]  # numbers that are not in its range

    def __str__(self) -> str:
        owner = f"{self.public.owner.__name__}." if self.public else ""
        return f"{owner}{self.thing.__name__}.{self.name}"


def is_method(public: Public) -> bool:
    """Whether it is a method that has an example."""
    is_made = public.owner is None or public.name.endswith(".__init__")
    return not is_made and needs_example(public)


def entries(text: str | None) -> Iterator[tuple[str, str]]:
    """Arguments and attributes of a docstring, each with what is said of it."""
    section, said, names = "", "", []
    for line in [*inspect.cleandoc(text or "").splitlines(), "End:"]:
        entry = ENTRY.match(line) if section in ("Args:", "Attributes:") else None
        if entry or not line.startswith(" "):
            yield from ((name, said) for name in names)
            names, said = (entry["names"].split(", "), entry["text"]) if entry else ([], "")
            section = section if entry or not line.strip() else line
        elif names:
            said += " " + line.strip()


def outside_of(said: str) -> tuple[float, ...]:
    """Numbers at and beyond the ends of the first range in a text."""
    found = RANGE.search(said)
    if found is None:
        return ()
    if found["more"]:
        least = float(found["than"])
        return (least - 1.0,) if found["more"] == ">=" else (least, least - 1.0)
    low, high = float(found["low"]), float(found["high"])
    ends = ((low,) if found["left"] == "(" else ()) + ((high,) if found["right"] == ")" else ())
    return (*ends, low - 0.25, high + 0.25)


def public_things() -> Iterator[tuple[Public | None, Any]]:
    """All functions and classes that are public, and the methods that have an example."""
    for room in map(importlib.import_module, load_api_page().packages()):
        for name in sorted(room.__all__):
            thing = getattr(room, name)
            is_kind = inspect.isclass(thing) and not issubclass(thing, BaseException)
            if (is_kind and thing not in ABSTRACT) or inspect.isfunction(thing):
                yield None, thing
    yield from ((public, public.function) for public in PUBLIC if is_method(public))


def find_ranged() -> list[Ranged]:
    """Arguments of which the docstring says a range."""
    found = {}
    for public, thing in public_things():
        for name, said in entries(thing.__doc__):
            ranged = Ranged(public, thing, name, outside_of(said))
            if ranged.outside and str(ranged) not in OTHERWISE:
                found[str(ranged)] = ranged
    return list(found.values())


def changed(arguments: dict[str, Any], name: str, bad: float) -> dict[str, Any]:
    """Arguments with one number out of range, the first of several."""
    value = arguments.get(name, bad)
    if isinstance(value, Tensor):
        value = value.detach().clone()
        value.view(-1)[0] = bad
    elif isinstance(value, (tuple, list)):
        value = (bad, *value[1:])
    else:
        value = int(bad) if isinstance(value, int) else bad
    return {**arguments, name: value}


def ask(ranged: Ranged, bad: float) -> None:
    """Call with a number out of range; of a class, also the methods that have an example."""
    public, thing, name, _ = ranged
    if public:
        function, given = example_of(public)
        function({**given, "call": changed(given["call"], name, bad)})
    elif not inspect.isclass(thing):
        arguments = {**CALL, **EXAMPLES}.get(thing.__name__, dict)()
        FACTORIES.get(thing.__name__, thing)(**changed(arguments, name, bad))
    else:
        arguments = changed(MAKE.get(thing, EXAMPLES.get(thing.__name__, dict))(), name, bad)
        ASKED.get(thing, lambda made: made)(FACTORIES.get(thing, thing)(**arguments))
        for method in PUBLIC:
            if method.owner is thing and is_method(method):
                function, given = example_of(method)
                function({**given, "make": arguments})


def arguments_of(public: Public | None, thing: Any) -> dict[str, Any]:
    """Right arguments of an example, and the numbers among the defaults."""
    if public:
        given = example_of(public)[1].get("call", {})
    else:
        given = (MAKE.get(thing) or CALL.get(thing.__name__) or dict)()
    defaults = {p.name: p.default for p in inspect.signature(thing).parameters.values()}
    return {k: v for k, v in {**defaults, **given}.items() if is_number(v)}


def is_number(value: Any) -> bool:
    if isinstance(value, Tensor):
        return value.is_floating_point() and value.numel() > 0 and value.ndim < 2
    first = value[0] if isinstance(value, (tuple, list)) and value else value
    return isinstance(first, (float, int)) and not isinstance(first, bool)


def refused_ranges() -> dict[str, list[float]]:
    """Ranges that refusals name, by argument: of all public arguments that are numbers.

    Of each the ends, zero where there is none, whether they belong to it, and whether they exist.
    """
    found: dict[str, list[float]] = {}
    for public, thing in public_things():
        for name in arguments_of(public, thing):
            ranged = Ranged(public, thing, name, ())
            if str(ranged) not in found and (said := interval_told(ranged)):
                told = [said["low"] or said["least"], said["high"] or "inf"]
                ends = [float(end.replace(",", "")) for end in told]
                exist = [math.isfinite(end) for end in ends]
                belong = [said["left"] != "(", said["right"] == "]"]
                found[str(ranged)] = [*np.where(exist, ends, 0.0), *belong, *exist]
    return found


def interval_told(ranged: Ranged) -> re.Match[str] | None:
    """The interval of the first refusal that names the argument."""
    is_count = False
    for bad in (*FAR, *map(int, FAR)):
        if isinstance(bad, int) and not is_count:
            return None
        try:
            ask(ranged, bad)
        except Exception as error:
            told = TOLD.search(str(error))
            if told and re.search(word_of(ranged), str(error)):
                return told
            is_count |= "whole number, got" in str(error)
    return None


def word_of(ranged: Ranged) -> str:
    word = IN_OTHER_WORDS.get(ranged.name, ranged.name)
    return r"(?i)\b" + word.removesuffix("s").replace("_", "[_ ]")


@pytest.mark.parametrize("ranged", find_ranged(), ids=str)
def test_what_is_said_to_be_out_of_range_is_refused_by_name(ranged):
    for bad in ranged.outside:
        with pytest.raises((ValueError, DiffsimError), match=word_of(ranged)):
            ask(ranged, bad)
