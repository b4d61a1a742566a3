"""Spoiled arguments of public functions end in an error that names the argument, or right."""

import math
import re
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from diffsim.core import DiffsimError, MeshError
from tests.fuzz_entries import ENTRIES

BUDGET_S = 10.0  # of CPU, for all of hypothesis' examples
CLEAR = (ValueError, TypeError, DiffsimError, NotImplementedError)
pytestmark = pytest.mark.filterwarnings("ignore")


def inference(value: Tensor) -> Tensor:
    with torch.inference_mode():
        return value.clone()


def strided(value: Tensor) -> Tensor:
    """The same numbers with gaps between them."""
    return torch.stack([value, value], -1)[..., 0]


def last_doubled(value: Tensor) -> Tensor:
    return torch.cat([value, value], -1) if value.dim() else value.expand(2)


def with_first(value: Tensor, what: float) -> Tensor:
    out = value.clone()
    out.view(-1)[:1] = what
    return out


SAME: dict[str, Callable[[Tensor], Any]] = {  # accepted with the same answer, or refused
    "list": lambda v: v.tolist(),
    "array": lambda v: v.numpy(),
    "inference": inference,
    "strided": strided,
    "needs gradient": lambda v: v.clone().requires_grad_(v.is_floating_point()),
}
TENSORS: dict[str, Callable[[Tensor], Any]] = {
    "float32": lambda v: v.to(torch.float32),
    "int32": lambda v: v.to(torch.int32),
    "bool": lambda v: v.to(torch.bool),
    "complex": lambda v: v.to(torch.complex128),
    "sparse": lambda v: v.to_sparse(),
    "meta": lambda v: v.to("meta"),
    "more axes": lambda v: v[None, None, None],
    "empty": lambda v: v[:0],
    "flat": lambda v: v.flatten()[:1],
    "scalar": lambda v: v.flatten()[0],
    "wide": last_doubled,
    "nan": lambda v: with_first(v, math.nan) if v.is_floating_point() else v - 1000,
    "infinite": lambda v: with_first(v, math.inf) if v.is_floating_point() else v + 1000,
    "huge": lambda v: v * 1e200 if v.is_floating_point() else v + 2**60,
}
NUMBERS: tuple[Any, ...] = (
    math.nan, math.inf, -math.inf, -1.0, 0.0, 2.5, 1e300, -1e300, 1e-300, -3, 0, True, 1j,
)  # fmt: skip
THINGS: tuple[Any, ...] = (
    None,
    "no such thing",
    "",
    [],
    {},
    [1.0, "a"],
    object(),
    b"x",
    [[1.0], []],
)


def spoilers(value: Any) -> dict[str, Any]:
    """Wrong or unusual values for an argument, by name."""
    found: dict[str, Any] = {f"thing {i}": thing for i, thing in enumerate(THINGS)}
    if isinstance(value, Tensor):
        found |= {name: change(value) for name, change in (SAME | TENSORS).items()}
    elif isinstance(value, (tuple, list)):
        found |= {"shorter": value[:-1], "longer": (*value, value[-1])}
        found |= {f"with {n}": (n, *value[1:]) for n in NUMBERS}
    else:
        found |= {str(number): number for number in NUMBERS}
        if isinstance(value, float):
            found |= {"array": np.float64(value), "scalar": torch.tensor(value).double()}
    return found


def numbers_of(result: Any) -> list[np.ndarray]:
    if isinstance(result, (tuple, list)):
        return [array for item in result for array in numbers_of(item)]
    plain = result.detach().resolve_conj().numpy() if isinstance(result, Tensor) else result
    return [np.asarray(plain)]


def complaint(name: str, changed: dict[str, Any], *hows: str) -> str:
    """What is wrong with the answer to changed arguments; empty: nothing."""
    entry = ENTRIES[name]
    arguments = {**entry.arguments(), **changed}
    begin = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = entry.call(**arguments)
    except CLEAR as error:
        return unclear(entry, changed, error)
    except BaseException as error:
        return f"{type(error).__name__}: {str(error)[:200]} at {place(error)}"
    if time.process_time() - begin > 5.0:
        return "took more than 5 s"
    is_huge = any("huge" in how or "e+300" in how for how in hows)  # numbers may overflow
    if not (is_huge or entry.passes_nan) and any(
        not np.isfinite(a).all() for a in numbers_of(result)
    ):
        return "not finite, without an error"
    return ""


def place(error: BaseException) -> str:
    """Where an error was raised."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{Path(last.filename).name}:{last.lineno}"


def unclear(entry: Any, changed: dict[str, Any], error: BaseException) -> str:
    """What is wrong with an error; empty: it is of the numerics, or names an argument."""
    if isinstance(error, (DiffsimError, MeshError, np.linalg.LinAlgError)):
        return ""
    if "unexpected keyword" in str(error):
        return f"the test's own mistake: {error}"
    words = [*entry.arguments(), *entry.words.values()]  # a shape may be held against another's
    stems = [w.removesuffix("s").replace("_", "[_ ]") for w in words]
    if any(re.search(rf"\b{stem}", str(error), re.IGNORECASE) for stem in stems):
        return ""
    return f"does not name {' or '.join(changed)}: {type(error).__name__}: {str(error)[:200]}"


def spoilable(name: str) -> list[str]:
    entry = ENTRIES[name]
    return [a for a in entry.arguments() if a not in entry.fixed]


@pytest.mark.parametrize("name", ENTRIES)
def test_every_argument_spoiled_alone(name):
    wrong = []
    given_right = ENTRIES[name].arguments()
    baseline = numbers_of(ENTRIES[name].call(**given_right))
    for argument in spoilable(name):
        for how, value in spoilers(given_right[argument]).items():
            if said := complaint(name, {argument: value}, how):
                wrong.append(f"{argument} {how}: {said}")
            elif how in SAME and isinstance(given_right[argument], Tensor):
                try:
                    again = numbers_of(ENTRIES[name].call(**{**given_right, argument: value}))
                except CLEAR:
                    continue
                if any(
                    not np.allclose(a, b, 1e-9, 1e-12) for a, b in zip(again, baseline, strict=True)
                ):
                    wrong.append(f"{argument} {how}: another answer")
    assert not wrong, "\n" + "\n".join(wrong)


_begin: list[float] = []
reasonable = st.floats(-1e6, 1e6) | st.sampled_from([math.nan, math.inf, -math.inf, 1e-300])


@settings(
    max_examples=120,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)
@given(st.data())
def test_arguments_spoiled_together(data):
    """Two arguments at a time, and random shapes and numbers, within a budget of time."""
    _begin.append(time.process_time())
    if time.process_time() - _begin[0] > BUDGET_S:
        return
    name = data.draw(st.sampled_from(sorted(ENTRIES)))
    right = ENTRIES[name].arguments()
    chosen = data.draw(
        st.lists(st.sampled_from(spoilable(name)), min_size=1, max_size=2, unique=True)
    )
    changed, hows = {}, []
    for argument in chosen:
        if isinstance(right[argument], Tensor) and data.draw(st.booleans()):
            shape = data.draw(st.lists(st.integers(0, 4), max_size=4))
            fill = data.draw(reasonable)
            changed[argument] = torch.full(shape, fill, dtype=torch.float64)
        elif isinstance(right[argument], float) and data.draw(st.booleans()):
            changed[argument] = data.draw(reasonable)
        else:
            options = spoilers(right[argument])
            hows.append(data.draw(st.sampled_from(sorted(options))))
            changed[argument] = options[hows[-1]]
    said = complaint(name, changed, *hows)
    assert not said, f"{name}({changed}): {said}"
