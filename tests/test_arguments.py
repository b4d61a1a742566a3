"""Every public signature with spoiled arguments: a right value, or a sentence that names them.

The right arguments are those of ``tests.derivatives``; ``tests.fuzz_entries`` has more.
"""

import dataclasses
import math
import re
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

from diffsim.core.errors import DiffsimError
from tests.derivatives import models  # noqa: F401 fills the tables
from tests.derivatives.check import REFUSED, rows
from tests.test_derivatives import PUBLIC, example_of, needs_example

pytestmark = pytest.mark.filterwarnings("ignore")
RAW = re.compile(r"not supported between|unsupported operand|has no attribute|argument '")
UNCHECKED = [
    r"\.(level|evaluate)$",  # of points that are checked already, as they say
    r"FlightState\.__init__$|(svd3|polar3)$",  # kept as given; NaN in, NaN out, as they say
    r"^diffsim\.(identify|systems|sim_to_real|envs)\.",  # called by a fit that made the arguments
]
SILENT = {  # infinity has a meaning here
    *("floor.friction", "penalty_force.friction", "sealed_pressure.volume"),
    *("MotorOutputs.command.max_thrusts", "MotorOutputs.limits.max_thrusts"),
}
"""Arguments that may be infinite."""
ELSEWHERE = {  # what is told is another argument, which no longer fits, or an index
    ("LQR.forward", "B", "wide"), ("interface", "nodes", "wide"),
    ("Muscle.__init__", "direction", "sparse"), ("RegionMesh.values", "region", "beyond"),
}  # fmt: skip
IN_OTHER_WORDS = {  # of what an argument becomes, or of a name that is an argument itself
    **{"height": "offset", "x_rest": "mesh", "law": "material", "source": "HexMesh"},
    **{"step": "time", "surface": "mesh file", "path": "elements", "value": "body_force"},
}


class Thing:
    """No argument of anything."""


def spoiled(value: Any) -> dict[str, Any]:
    """Wrong or unusual values of an argument, by name."""
    found: dict[str, Any] = {"text": "no such thing", "nothing": None, "thing": Thing()}
    if isinstance(value, Tensor) and value.layout is torch.strided:
        with torch.inference_mode():
            found["inference"] = value.clone()
        found["strided"] = torch.stack([value, value], -1)[..., 0]
        found["negated"] = (-value)._neg_view()  # memory of the other sign, as conj().imag has
        found |= {"empty": value.new_zeros(0), "list": value.tolist(), "axes": value[None, None]}
        found |= {"complex": value.to(torch.complex128), "meta": value.to("meta")}
        found |= {"sparse": value.to_sparse()}
        found["wide"] = torch.cat([value, value], -1) if value.dim() else value.expand(2)
        if value.is_floating_point() and value.numel():
            found |= {"float32": value.float(), "huge": value * 1e200}
            for what in (math.nan, math.inf, -math.inf):
                found[str(what)] = value.clone().contiguous()
                found[str(what)].view(-1)[0] = what
        else:
            found |= {"beyond": value + 1000, "before": value - 1000}
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        found |= {str(number): number for number in (math.nan, math.inf, -1e300, 1j)}
    return found


def refusal(given, arguments: list[str], error: Exception) -> str:
    """What is wrong with an error; empty: it is of the numerics, or names an argument."""
    if not isinstance(error, (*REFUSED, DiffsimError)):
        return f"raw: {error!r}"
    parts = [part for part in given.values() if isinstance(part, dict)]
    words = [IN_OTHER_WORDS.get(word, word) for word in arguments]
    words += [word for part in parts if {*arguments} & {*part} for word in part]
    stems = "|".join(word.removesuffix("s").replace("_", "[_ ]") for word in words)
    named = isinstance(error, DiffsimError) or re.search(rf"\b({stems})", str(error), re.I)
    return "" if named and not RAW.search(str(error)) else f"unclear: {error!r}"


def complaint(function, given, before, part: str, argument: str, how: str, bad: Any) -> str:
    """What is wrong with the answer to a spoiled argument; empty: nothing."""
    given = {**given, part: {**given[part], argument: bad}}
    try:
        after = rows(function(given))
    except Exception as error:
        return refusal(given, [argument], error)
    same = [a.shape for a in before] == [a.shape for a in after] and all(
        torch.allclose(a, b, 1e-12, 0.0) for a, b in zip(before, after, strict=True)
    )
    if how in ("nan", "-inf", "inf", "strided", "negated", "inference") and not same:
        return "silent"
    return "" if how != "huge" or all(bool(a.isfinite().all()) for a in after) else "not finite"


def is_checked(public) -> bool:
    return needs_example(public) and not any(re.search(p, public.name) for p in UNCHECKED)


CHECKED = list(filter(is_checked, PUBLIC))


@pytest.mark.parametrize(
    "public",
    CHECKED,
    ids=lambda public: public.name.removeprefix("diffsim."),
)
def test_spoiled_arguments_are_refused_by_name(public, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a wrong path may be one to write to
    function, given = example_of(public)
    before = rows(function(given))
    parts = {k: v for k, v in given.items() if isinstance(v, dict)}
    wrong = [
        f"{argument} {how}: {said}"
        for part, arguments in parts.items()
        for argument, value in arguments.items()
        for how, bad in spoiled(value).items()
        if f"{public.names[0]}.{argument}" not in SILENT
        if (public.names[0], argument, how) not in ELSEWHERE
        if (said := complaint(function, given, before, part, argument, how, bad))
    ]
    assert not wrong, "\n" + "\n".join(wrong)


@settings(
    max_examples=400,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)
@given(st.data())
def test_two_arguments_spoiled_together_are_refused_by_name(data):
    public = data.draw(st.sampled_from(CHECKED))
    function, right = example_of(public)
    places = [(part, name) for part, own in right.items() if isinstance(own, dict) for name in own]
    changed, hows = right, []
    for part, name in data.draw(
        st.lists(st.sampled_from(places), min_size=1, max_size=2, unique=True)
    ):
        options = spoiled(right[part][name])
        hows.append((name, data.draw(st.sampled_from(sorted(options)))))
        changed = {**changed, part: {**changed[part], name: options[hows[-1][1]]}}
    if any((public.names[0], *how) in ELSEWHERE for how in hows):
        return
    try:
        function(changed)
    except Exception as error:
        said = refusal(right, [name for name, _ in hows], error)
        assert not said, f"{public.name} {hows}: {said}"


def records() -> dict[str, Any]:
    """Records without a method that needs an example, made by hand."""
    from diffsim import envs, optim
    from diffsim.copter import simulator
    from diffsim.copter.simulator.mission import Leg, Mission
    from diffsim.copter.vehicle.parts import rotors
    from diffsim.stokes import Inlet, Open

    legs = (Leg(name="up", start=0.0, duration=1.0, pose=np.zeros(4), move=np.ones(4)),)
    made = [
        *(optim.Tolerances(), optim.Budget(), envs.Entry("tip", -1.0, 1.0), Open("x+"), *legs),
        *(envs.Randomization({"mass": (0.9, 1.1)}), Inlet("x-"), Mission("up", legs)),
        *(simulator.Sticks(), rotors.rotor_data("kde2814_8in")),
    ]
    return {type(record).__name__: record for record in made}


@pytest.mark.parametrize(
    "name", ["Tolerances", "Entry", "Randomization", "Open", "Inlet", "Sticks", "RotorData",
             "Leg", "Mission", "Budget"],
)  # fmt: skip
def test_spoiled_fields_of_records_are_refused_by_name(name):
    record = records()[name]
    wrong = []
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if not isinstance(value, (int, float, str, dict, tuple)):
            continue
        bads = [None, Thing(), b"x", [Thing()], math.nan]
        bads += [] if isinstance(value, str) else ["text"]
        for bad in bads:
            if bad is None and "None" in str(field.type):
                continue
            try:
                dataclasses.replace(record, **{field.name: bad})
                wrong.append(f"{field.name} {bad!r}: silent")
            except Exception as error:
                named = refusal({}, [field.name], error)
                wrong += [f"{field.name} {bad!r}: {named}"] if named else []
    assert not wrong, "\n" + "\n".join(wrong)
