"""What is public and takes tensors, found as ``scripts/api_page.py`` finds what is public."""

import importlib
import importlib.util
import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from torch import nn

from tests.scripts import load_script

_CALLABLE = re.compile(r"Callable\[\[[^\]]*\], [^\]]*(?:\[[^\]]*\])?\]")
CALLED = ("__call__", "forward")


@dataclass(frozen=True)
class Public:
    """A function, or a method of a class (``__init__``: the class itself)."""

    name: str  # room and name, such as "diffsim.soft.Tendon.tension"
    function: Callable[..., Any]  # what is called
    owner: type | None = None  # the class; None for a function

    @property
    def names(self) -> list[str]:
        """Names under which an example may be given: of the class itself, and of its bases."""
        if self.owner is None:
            return [self.name.rpartition(".")[2]]
        method = self.name.rpartition(".")[2]
        return [f"{kind.__name__}.{method}" for kind in self.owner.__mro__]


def load_api_page() -> ModuleType:
    """The script that writes ``docs/api.md``."""
    return load_script("api_page.py")


def find_public() -> list[Public]:
    """All that is public and takes a tensor, or a record of tensors, each once.

    Protocols and abstract methods are left out: who fulfils them is looked at.
    """
    things = [
        (f"{room}.{name}", getattr(importlib.import_module(room), name))
        for room in load_api_page().packages()
        for name in sorted(importlib.import_module(room).__all__)
    ]
    kinds = {thing.__name__ for _, thing in things if inspect.isclass(thing) and holds(thing)}
    takes = re.compile(rf"\b({'|'.join(sorted(kinds | {'Tensor'}))})\b")
    found: dict[Any, Public] = {}
    for name, thing in things:
        for one in _of(name, thing, takes):
            found.setdefault((one.owner, one.function), one)
    return list(found.values())


def holds(kind: type) -> bool:
    """Whether a class is a record with tensors in it."""
    fields = getattr(kind, "__annotations__", {})
    is_plain = hasattr(kind, "_fields") or hasattr(kind, "__dataclass_fields__")
    return is_plain and any("Tensor" in _CALLABLE.sub("", str(a)) for a in fields.values())


def _of(name: str, thing: Any, takes: re.Pattern[str]) -> Iterator[Public]:
    if inspect.isclass(thing):
        yield from _of_class(name, thing, takes)
    elif inspect.isroutine(thing) and takes_tensor(thing, takes):
        yield Public(name, thing)


def _of_class(name: str, kind: type, takes: re.Pattern[str]) -> Iterator[Public]:
    if getattr(kind, "_is_protocol", False) or issubclass(kind, BaseException):
        return
    if not is_record(kind) and takes_tensor(kind.__init__, takes):
        yield Public(f"{name}.__init__", kind.__init__, kind)
    for method, function in inspect.getmembers(kind, inspect.isroutine):
        if method.startswith("_") and method not in CALLED:
            continue
        if not str(getattr(function, "__module__", "")).startswith("diffsim"):
            continue
        if getattr(function, "__isabstractmethod__", False) or not takes_tensor(function, takes):
            continue
        yield Public(f"{name}.{method}", function, kind)


def is_record(kind: type) -> bool:
    """Whether a class only keeps what it is given: a named tuple, or a dataclass that looks at
    nothing."""
    if hasattr(kind, "_fields"):
        return True
    is_generated = "__init__" in vars(kind) and hasattr(kind, "__dataclass_fields__")
    return is_generated and not hasattr(kind, "__post_init__") and not issubclass(kind, nn.Module)


def takes_tensor(function: Callable[..., Any], takes: re.Pattern[str]) -> bool:
    """Whether an argument is annotated as a tensor, or as something with tensors in it."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return False
    said = [_CALLABLE.sub("", str(p.annotation)) for p in parameters]
    named = getattr(inspect.unwrap(function), "__globals__", {})
    aliases = {n for n in re.findall(r"\w+", " ".join(said)) if _is_alias_of_tensor(named.get(n))}
    return any(takes.search(text) or aliases & set(re.findall(r"\w+", text)) for text in said)


def _is_alias_of_tensor(value: Any) -> bool:
    """Whether a name such as ``Vector`` stands for a tensor among others."""
    is_alias = not inspect.isclass(value) and hasattr(value, "__args__")
    return is_alias and "Tensor" in _CALLABLE.sub("", str(value))
