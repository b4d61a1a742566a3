"""Derivatives by every floating tensor of a call: reverse and forward mode against differences.

Both are asked of ``torch.autograd`` and of ``torch.func``, whose ``vmap`` must give what a loop
does.
"""

import dataclasses
import math
import re
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import torch
import torch.autograd.forward_ad as forward_mode
from torch import Tensor, func

from diffsim import stokes
from diffsim.copter import HoverResult
from diffsim.core.errors import DiffsimError
from diffsim.core.numbers import values_of

REFUSED = (TypeError, ValueError, NotImplementedError, DiffsimError)
CLEAR = re.compile(r"grad|derivative|differentiat|order|detach|mapped")
NO_NUMBER = re.compile(r"number|got Tensor")
STEP = 1e-5
REPORTS = {HoverResult: ("multipliers",), stokes.FlowField: ("stats", "solve")}
"""Fields that tell how a result was computed; their docstrings say that none has a gradient."""
Path = tuple[Any, ...]


def numbers(value: Any, path: Path = ()) -> Iterator[tuple[Path, float]]:
    """All plain numbers in arguments, in lists too, which somebody may give as tensors."""
    if isinstance(value, float) and math.isfinite(value):
        yield path, value
    if isinstance(value, (Mapping, list, tuple)) and not hasattr(value, "_fields"):
        for key, part in parts_of(value):
            yield from numbers(part, (*path, key))


def leaves(value: Any, path: Path = ()) -> Iterator[tuple[Path, Tensor]]:
    """All floating tensors in arguments, in records and containers too, by where they are."""
    if isinstance(value, Tensor):
        if value.is_floating_point() and value.layout is torch.strided and value.numel():
            yield path, value
        return
    for key, part in parts_of(value):
        yield from leaves(part, (*path, key))


def parts_of(value: Any) -> list[tuple[Any, Any]]:
    """Parts of a container or record by key; of anything else none."""
    if isinstance(value, Mapping):
        return list(value.items())
    if hasattr(value, "_fields"):
        return list(value._asdict().items())
    if isinstance(value, (list, tuple)):
        return list(enumerate(value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return [(f.name, getattr(value, f.name)) for f in dataclasses.fields(value)]
    return []


def with_leaf(value: Any, path: Path, leaf: Tensor) -> Any:
    """The arguments with another tensor in one place; everything around it is made anew."""
    if not path:
        return leaf
    key, *rest = path
    part = dict(parts_of(value))[key]
    changed = with_leaf(part, tuple(rest), leaf)
    if isinstance(value, Mapping):
        return {**value, key: changed}
    if hasattr(value, "_fields"):
        return value._replace(**{key: changed})
    if isinstance(value, (list, tuple)):
        return type(value)(changed if k == key else v for k, v in enumerate(value))
    return dataclasses.replace(value, **{key: changed})


def flat(out: Any) -> Tensor:
    """All floating tensors of a result in a row; infinite ones have no differences."""
    parts = [part.flatten().double()[values_of(part).flatten().isfinite()] for part in rows(out)]
    return torch.cat(parts) if parts else torch.zeros(0, dtype=torch.float64)


def rows(out: Any) -> list[Tensor]:
    """All floating tensors of a result but for those that tell how it was computed."""
    reports = REPORTS.get(type(out), ())
    return [part for path, part in leaves(out) if not path or path[0] not in reports]


def check(function: Callable[[Any], Any], given: Any, kind: type = Tensor) -> dict[str, str]:
    """What each leaf gives, by its place: "moves", "still", "held" or "refused"; wrong ones raise.

    Args:
        function: Of the arguments; its floating tensors are looked at.
        given: Arguments.
        kind: ``Tensor``, or ``float``: plain numbers that are given as tensors, which may be
            refused for being no numbers; or ``list``: the first entries of vectors that are given
            as lists, of which torch drops the gradients.
    """
    found: dict[str, str] = {}
    if kind is list:
        for path, vector in leaves(given):
            if vector.ndim == 1 and 1 < len(vector) < 9:
                first, *rest = vector.tolist()

                def of(entry: dict[str, Any], path: Path = path, rest: list[float] = rest) -> Any:
                    return function(with_leaf(given, path, [entry[str(path)], *rest]))

                if _is_taken(of, {str(path): first}):
                    found |= _each(of, {str(path): first}, [((str(path),), first)], float)
        return found
    return _each(function, given, (numbers if kind is float else leaves)(given), kind)


def _is_taken(function, given) -> bool:
    try:
        function(given)
    except Exception:  # tests of arguments look at how
        return False
    return True


def _each(function, given, places, kind: type) -> dict[str, str]:
    plain, found = flat(function(given)).detach(), {}
    for path, value in places:
        place = ".".join(map(str, path))
        leaf = torch.tensor(value, dtype=torch.float64) if kind is float else value.detach()
        try:
            found[place] = _check_leaf(function, given, path, leaf, plain, kind)
            if kind is not float:
                _check_mapped(partial(_rows_of, function, given, path), leaf)
        except AssertionError as error:
            raise AssertionError(f"{place}: {error}") from None
    return found


def _check_leaf(function, given, path: Path, leaf: Tensor, plain: Tensor, kind: type) -> str:
    random = torch.Generator().manual_seed(len(path))
    size = max(float(leaf.abs().max()), 1e-3)
    direction = size * torch.randn(leaf.shape, generator=random, dtype=leaf.dtype)
    if leaf.ndim == 2 and leaf.shape[0] == leaf.shape[1] and torch.equal(leaf, leaf.T):
        direction = direction + direction.T  # an inertia stays one
    weight = torch.randn(plain.shape, generator=random, dtype=torch.float64)
    scale = float((weight * plain).abs().sum())
    modes = dict.fromkeys(MODES[:2] if kind is float else MODES)
    for mode in modes:
        of = partial(mode, lambda x: flat(function(with_leaf(given, path, x))))
        modes[mode] = _asked(partial(of, leaf, direction, weight), kind)
    slopes = [slope for slope in modes.values() if slope is not None]
    if not slopes:
        return "refused"  # a mode alone may be refused, too
    try:
        expected = _difference(function, given, path, leaf, direction, weight, kind)
    except REFUSED:  # a sign, a unit vector: it cannot be moved a little, but modes must agree
        assert max(slopes) - min(slopes) <= 1e-9 * (scale + abs(slopes[0]))
        return "held"
    for mode, slope in modes.items():
        assert slope is None or abs(slope - expected) <= (
            1e-4 * abs(expected) + 1e-7 * scale + 1e-12
        ), f"{mode.__doc__} gives {slope:.6g}, differences {expected:.6g}"
    return "moves" if abs(expected) > 1e-7 * scale else "still"


def _asked(work: Callable[[], float], kind: type) -> float | None:
    """A slope; None where it is refused in words."""
    try:
        return work()
    except REFUSED as error:
        says = CLEAR.search(str(error)) or (kind is float and NO_NUMBER.search(str(error)))
        assert says, f"refused without saying why: {error!r}"
        return None


def _reverse(of, leaf, direction, weight) -> float:
    """reverse mode"""
    asked = leaf.clone().requires_grad_()
    out = of(asked)
    if not out.requires_grad:
        return 0.0
    (grad,) = torch.autograd.grad((weight * out).sum(), asked, allow_unused=True)
    return 0.0 if grad is None else float((grad * direction).sum())


def _forward(of, leaf, direction, weight) -> float:
    """forward mode"""
    with forward_mode.dual_level():
        out = of(forward_mode.make_dual(leaf.clone(), direction))
        tangent = forward_mode.unpack_dual(out).tangent
        return 0.0 if tangent is None else float((weight * tangent).sum())


def _func_reverse(of, leaf, direction, weight) -> float:
    """torch.func.grad"""
    grad = func.grad(lambda x: (weight * of(x)).sum())(leaf.clone())
    return float((grad * direction).sum())


def _func_forward(of, leaf, direction, weight) -> float:
    """torch.func.jvp"""
    return float((weight * func.jvp(of, (leaf.clone(),), (direction,))[1]).sum())


MODES = (_reverse, _forward, _func_reverse, _func_forward)


def _rows_of(function, given, path: Path, leaf: Tensor) -> list[Tensor]:
    return rows(function(with_leaf(given, path, leaf)))


def _check_mapped(of: Callable[[Tensor], list[Tensor]], leaf: Tensor) -> None:
    """``torch.func.vmap`` of two leaves gives what each gives alone, or is refused in words."""
    both = torch.stack([leaf, (1.0 + STEP) * leaf + STEP])
    try:
        each = [of(item.clone()) for item in both]
    except REFUSED:  # a sign, a unit vector: it cannot be moved a little
        both = torch.stack([leaf, leaf])
        each = [of(leaf.clone())] * 2
    try:
        mapped = func.vmap(lambda x: tuple(of(x)), randomness="same")(both)
    except REFUSED as error:
        assert CLEAR.search(str(error)), f"refused without saying why: {error!r}"
        return
    for k, item in enumerate(each):
        for got, expected in zip(mapped, item, strict=True):
            torch.testing.assert_close(got[k], expected, rtol=1e-9, atol=1e-12, equal_nan=True)


def _difference(function, given, path, leaf, direction, weight, kind) -> float:
    as_given = float if kind is float else torch.clone
    ends = [
        flat(function(with_leaf(given, path, as_given(leaf + sign * STEP * direction)))).detach()
        for sign in (1.0, -1.0)
    ]
    return float((weight * (ends[0] - ends[1])).sum() / (2.0 * STEP))
