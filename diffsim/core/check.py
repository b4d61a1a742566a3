"""Argument checks in one message style: what is required, what came, what to do."""

from __future__ import annotations

import difflib
import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import is_dataclass
from typing import Any

import torch
from torch import Tensor

from diffsim.core.layer import may_be_differentiated
from diffsim.core.numbers import asks_derivative, require_unmapped, values_of
from diffsim.core.torch_names import has_function_modes


def require(
    name: str,
    value: Tensor,
    shape: Sequence[int | str],
    dtype: torch.dtype = torch.float64,
    *,
    finite: bool = True,
) -> Tensor:
    """Check dtype, device, shape and finiteness of a tensor; make its memory what it says.

    Args:
        name: The argument's name, for the message.
        shape: Expected shape; strings stand for any size, a leading ``"..."`` for any batch axes.
        dtype: Dtype that the tensor must have.
        finite: Refuse NaN and infinity (not while ``torch.compile`` traces, without values).

    Returns:
        ``value``, contiguous and without the negative bit that a view of a conjugate has.

    Raises:
        TypeError: not a tensor, sparse or nested, wrong dtype or device, without values.
        ValueError: wrong shape, or not finite.
    """
    require_shape(name, value, shape, dtype)
    if torch.compiler.is_compiling():
        return value.contiguous()
    if value.is_neg():
        value = value.resolve_neg()
    if value.is_inference() and not torch.is_inference_mode_enabled():
        value = value.clone()  # one made in inference mode cannot be kept for a gradient
    if not finite or not value.is_floating_point():
        return value.contiguous()
    numbers = values_of(value)
    if not all_finite(numbers):
        bad = torch.nonzero(~torch.isfinite(numbers))
        first = tuple(int(i) for i in bad[0])
        raise ValueError(
            f"{name} must be finite, got {len(bad)} NaN or infinite entries, first at {first}"
        )
    return value.contiguous()


def require_shape(
    name: str, value: Tensor, shape: Sequence[int | str], dtype: torch.dtype = torch.float64
) -> None:
    """``require`` of what is kept as it is: neither its numbers nor their order are looked at.

    Raises:
        TypeError: not a tensor, sparse or nested, wrong dtype or device, without values.
        ValueError: wrong shape.
    """
    require_tensor(name, value, dtype)
    if not _fits(value.shape, shape):
        expected = ", ".join(str(s) for s in shape)
        raise ValueError(f"{name} must have shape ({expected}), got {tuple(value.shape)}")


def require_tensor(name: str, value: Tensor, dtype: torch.dtype = torch.float64) -> None:
    """Check that a value is a tensor of a dtype whose numbers kernels can read.

    Raises:
        TypeError: not a tensor, sparse or nested, wrong dtype or device, without values.
    """
    if not torch.compiler.is_compiling() and has_function_modes():
        _refuse_default_device()
    if not isinstance(value, Tensor):
        raise TypeError(
            f"{name} must be a torch.Tensor, got {type(value).__name__}; "
            f"convert with torch.as_tensor({name}, dtype={dtype})"
        )
    if value.layout is not torch.strided or value.is_nested:
        raise TypeError(
            f"{name} must be dense, got layout {value.layout}; convert with {name}.to_dense()"
        )
    if value.dtype != dtype:
        raise TypeError(
            f"{name} must be {dtype}, got {value.dtype}; convert with {name}.to({dtype})"
        )
    if not value.is_cpu:
        if value.is_meta:
            raise TypeError(f"{name} must be on the CPU, got device meta: a shape without values")
        raise TypeError(f"{name} must be on the CPU, got device {value.device}; use {name}.cpu()")


def _refuse_default_device() -> None:
    """Refuse a default device other than the CPU, on which tensors would be made here and there."""
    default = torch.get_default_device()
    if default.type != "cpu":
        raise TypeError(
            f"diffsim computes on the CPU, but torch.set_default_device({str(default)!r}) is in "
            "effect; build and call its objects under `with torch.device('cpu'):`"
        )


def require_constant(name: str, value: Any, hint: str = "") -> None:
    """Refuse tensors that a derivative is asked of, or that are mapped, where none is computed.

    Args:
        name: The argument's name, for the message.
        value: A tensor, a list of them, or anything else, which is let pass.
        hint: What carries a derivative instead.

    Raises:
        ValueError: a tensor requires a gradient, or moves in forward mode.
        NotImplementedError: a tensor is mapped by ``torch.func.vmap``.
    """
    parts = value if isinstance(value, (list, tuple)) else (value,)
    tensors = [part for part in parts if isinstance(part, Tensor)]
    for part in tensors:
        require_unmapped(**{name: part})
    if any(map(asks_derivative, tensors)):
        raise ValueError(
            f"{name} must not require grad: no derivative by it is computed; pass "
            f"{name}.detach(){_hint(hint)}"
        )


def require_constants(hint: str, **given: Any) -> None:
    """``require_constant`` of arguments and of what records hold, where gradients are recorded.

    For results that are computed past PyTorch on purpose; under ``torch.no_grad()`` nobody can take
    them for followed.
    """
    if not may_be_differentiated():
        return
    for name, value in given.items():
        require_constant(name, value, hint)
        parts = vars(value) if is_dataclass(value) else getattr(value, "_asdict", dict)()
        require_constants(hint, **{f"{name}.{field}": part for field, part in parts.items()})


def _fits(got: Sequence[int], want: Sequence[int | str]) -> bool:
    """Whether a shape is as wanted; see ``require``."""
    if want and want[0] == "...":
        want = want[1:]
        if len(got) < len(want):
            return False
        got = got[len(got) - len(want) :]
    elif len(got) != len(want):
        return False
    for size, wanted in zip(got, want, strict=True):  # called too often for a generator
        if size != wanted and not isinstance(wanted, str):
            return False
    return True


def all_finite(value: Tensor) -> bool:
    """Whether no entry is NaN or infinite."""
    # a sum is the cheapest look at all entries; finite ones may overflow it, and are looked at
    return math.isfinite(float(value.sum())) or bool(torch.isfinite(value).all())


LARGEST = 1e150
"""Squares of larger numbers are none."""
LEAST = 1e-130
"""What must be positive is at least this: squares of its parts by rounding are numbers yet."""


def require_number(
    name: str,
    value: float,
    *,
    above: float = -math.inf,
    below: float = math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    hint: str = "",
) -> float:
    """Check that a number is finite and lies in a range; ``hint`` says how to mend it.

    A number of NumPy, or a () tensor without gradient, is taken as Python's.
    """
    if getattr(value, "ndim", None) == 0:
        require_constant(name, value, hint)
        value = _item(name, value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{name} must be a number, got {type(value).__name__}{_hint(hint)}")
    try:
        value = float(value)
    except OverflowError:  # a whole number of more than 308 digits
        value = math.inf
    if above == 0.0 < value < LEAST:
        above, at_least = -math.inf, LEAST
    if not (math.isfinite(value) and above < value < below and at_least <= value <= at_most):
        interval = _interval(above, below, at_least, at_most)
        raise ValueError(f"{name} must lie in {interval}, got {value:g}{_hint(hint)}")
    return value


def _item(name: str, value: Any) -> Any:
    if isinstance(value, Tensor) and (value.is_meta or value.layout is not torch.strided):
        raise TypeError(f"{name} must be a number, got a tensor without plain values")
    return value.item()


def require_range(
    name: str,
    value: Tensor,
    *,
    above: float = -math.inf,
    below: float = math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    hint: str = "",
) -> Tensor:
    """``require_number`` for every entry of a tensor; the message shows the worst entry."""
    require_tensor(name, value)
    v = values_of(value)
    if not v.numel():
        return value
    low, high = (float(extreme) for extreme in torch.aminmax(v))  # NaN where an entry is
    if above == 0.0 < low < LEAST:
        above, at_least = -math.inf, LEAST
    if above < low and high < below and at_least <= low and high <= at_most:
        return value
    bad = ~((v > above) & (v < below) & (v >= at_least) & (v <= at_most))
    if bool(bad.any()):
        worst = float(v[bad].flatten()[0])
        interval = _interval(above, below, at_least, at_most)
        raise ValueError(f"{name} must lie in {interval}, got {worst:g}{_hint(hint)}")
    return value


def require_choice(name: str, value: str, choices: Iterable[str]) -> str:
    """Check a name against the known ones; the message offers the closest matches."""
    known = list(choices)
    if value in known:
        return value
    raise ValueError(f"{name} must be one of {known}, got {value!r}{did_you_mean(value, known)}")


def as_spelled(value: str, known: Iterable[str]) -> str:
    """A name as known ones spell it: the only one that differs by case alone, else as it is.

    Earlier files have places of causes in small letters.
    """
    alike = {name for name in known if name.lower() == value.lower()}
    return alike.pop() if value not in alike and len(alike) == 1 else value


def did_you_mean(value: str, known: Iterable[str]) -> str:
    """The known names closest to one that is not known, as the end of a message; may be empty."""
    close = difflib.get_close_matches(str(value), list(known), n=3, cutoff=0.4)
    return f"; did you mean {' or '.join(map(repr, close))}?" if close else ""


def require_indices(name: str, value: Tensor, size: int, of: str) -> Tensor:
    """Check that integer indices lie in [0, size)."""
    numbers = values_of(value)
    if numbers.numel() and (int(numbers.min()) < 0 or int(numbers.max()) >= size):
        bad = numbers[(numbers < 0) | (numbers >= size)].flatten()
        raise ValueError(
            f"{name} must hold indices of {of} in [0, {size}), got {int(bad[0])}"
            + (f" and {bad.numel() - 1} more out of range" if bad.numel() > 1 else "")
        )
    return value


def _interval(above: float, below: float, at_least: float, at_most: float) -> str:
    low = f"({above:g}" if above > at_least or at_least == -math.inf else f"[{at_least:g}"
    high = f"{below:g})" if below < at_most or at_most == math.inf else f"{at_most:g}]"
    return f"{low}, {high}"


def _hint(hint: str) -> str:
    return f"; {hint}" if hint else ""


_BY_NAME = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)

MAX_COUNT = 2**31 - 1


def require_count(name: str, value: Any, *, at_least: int = 0) -> int:
    """Check that a number is whole and not too small; 3.0 and NumPy's 3 are taken as 3.

    Raises:
        TypeError: not a number.
        ValueError: not whole, too small, or not finite.
    """
    plain = value.item() if getattr(value, "ndim", None) == 0 else value
    if isinstance(plain, bool) or not isinstance(plain, (int, float)):
        raise TypeError(f"{name} must be a number, got {type(plain).__name__}")
    if not at_least <= plain <= MAX_COUNT or plain != int(plain):  # NaN is nowhere
        upper = "" if plain < MAX_COUNT else f" and at most {MAX_COUNT}"
        raise ValueError(f"{name} must be a whole number >= {at_least}{upper}, got {plain!r}")
    return int(plain)


MAX_THREADS = 1024
"""More than any processor runs; a larger number is a mistake, or the size of something else."""


def require_threads(num_threads: int) -> int:
    """Check the number of threads of a call: a whole number from 1 to ``MAX_THREADS``."""
    count = require_count("num_threads", num_threads, at_least=1)
    if count > MAX_THREADS:
        raise ValueError(
            f"num_threads must lie in [1, {MAX_THREADS}], got {count}; more than the processor has "
            "cores does not pay"
        )
    return count


def require_numbers(
    name: str, values: Sequence[float], count: int | Sequence[int], **limits: Any
) -> tuple[float, ...]:
    """Check so many finite numbers within limits: a list, a tuple, an array or a tensor.

    Args:
        name: The argument's name, for the message.
        count: How many there must be, or which counts will do.
        **limits: As of ``require_number``.

    Raises:
        TypeError: no numbers.
        ValueError: another count, or a number out of its limits.
    """
    counts = (count,) if isinstance(count, int) else tuple(count)
    wanted = " or ".join(map(str, counts))
    if isinstance(values, (str, bytes, Mapping)):
        raise TypeError(f"{name} must be {wanted} numbers, got {values!r}")
    try:
        given = list(values)
    except TypeError:
        raise TypeError(f"{name} must be {wanted} numbers, got {values!r}") from None
    if len(given) not in counts:
        raise ValueError(f"{name} must be {wanted} numbers, got {len(given)}: {given!r}")
    return tuple(require_number(f"{name}[{k}]", v, **limits) for k, v in enumerate(given))


def require_counts(name: str, values: Sequence[int], count: int | Sequence[int]) -> tuple[int, ...]:
    """``require_numbers`` of whole numbers from 1 on."""
    numbers = require_numbers(name, values, count)
    return tuple(require_count(f"{name}[{k}]", n, at_least=1) for k, n in enumerate(numbers))


def require_entries(name: str, entries: Iterable[Any], kind: type, hint: str = "") -> None:
    """Check that all entries of a sequence are of a class.

    Raises:
        TypeError: one is not, with its place.
    """
    article = "an" if kind.__name__[0] in "AEIO" else "a"
    for k, entry in enumerate(entries):
        if not isinstance(entry, kind):
            got = type(entry).__name__
            why = f"; {hint}" if hint else ""
            raise TypeError(f"{name}[{k}] must be {article} {kind.__name__}, got {got}{why}")


def require_options(what: str, options: Iterable[str], *takers: Callable[..., Any]) -> None:
    """Check that some function takes each option; the message offers the closest names.

    Args:
        what: What the options are of, for the message, such as "CopterHover".
        options: Names of keyword arguments.
        takers: Functions or classes that take them.

    Raises:
        ValueError: no taker has such an option.
    """
    names = [name for taker in takers for name in option_names(taker)]
    for name in options:
        require_choice(f"option of {what}", name, dict.fromkeys(names))


def option_names(taker: Callable[..., Any]) -> tuple[str, ...]:
    """Names of arguments; of a class with ``**options`` those of the classes that it is from, too.

    Args:
        taker: A function or a class.
    """
    classes = taker.__mro__ if isinstance(taker, type) else ()
    made = [vars(kind)["__init__"] for kind in classes if "__init__" in vars(kind)]
    names: dict[str, None] = {}
    for function in made or [taker]:
        given: Mapping[str, inspect.Parameter] = inspect.signature(function).parameters
        names |= {p.name: None for p in given.values() if p.name != "self" and p.kind in _BY_NAME}
        if not any(p.kind is p.VAR_KEYWORD for p in given.values()):
            break
    return tuple(names)
