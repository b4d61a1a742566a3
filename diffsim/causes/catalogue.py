"""All causes that the library knows, one row each, read from the tables beside this file.

A table has a domain: what commands pass (``actuator``), what shows channels (``sensor``), and one
for each kind of system. Who looks for a cause, its usual size or its words finds them there. A
table may take rows of another one, ``{include: load/tip_mass}``, or all of it, ``{include:
actuator}``: then it says in which order its system has them. Keys beside ``include`` replace those
of the rows, such as ``when: asked``; ``each: record`` says that a row is of the instruments of all
channels together. A kind of system of another package has its table ``KIND.yaml`` beside the module
of its description.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pydantic import ValidationError

from diffsim.causes.row import Row
from diffsim.core.check import did_you_mean
from diffsim.core.checked import checked
from diffsim.core.errors import Mistakes
from diffsim.core.plugins import SYSTEMS, find_plugins
from diffsim.core.schema import problem_lines
from diffsim.core.yaml_text import read_yaml_file

_HERE = Path(__file__).parent


def domains() -> tuple[str, ...]:
    """Names of the tables, those of other packages last."""
    own = sorted(path.stem for path in _HERE.glob("*.yaml"))
    return (*own, *(name for name in find_plugins(SYSTEMS) if _path_of(name).is_file()))


def _path_of(domain: str) -> Path:
    """The table of a domain: ours, or that beside the module of another package's description."""
    path = _HERE / f"{domain}.yaml"
    entry = find_plugins(SYSTEMS).get(domain)
    if entry is None or path.is_file():
        return path
    module = find_spec(entry.module)
    return (
        path
        if module is None or module.origin is None
        else Path(module.origin).with_name(path.name)
    )


@cache
@checked(kinds_only=True)
def rows(domain: str) -> Mapping[str, Row]:
    """Causes of a domain by name, in the order in which they act; without those of other tables.

    Args:
        domain: One of ``domains()``.

    Raises:
        ValueError: no such domain, or a table with mistakes.
    """
    return MappingProxyType({row.name: row for of, row in rows_in_order(domain) if of == domain})


@cache
def rows_in_order(domain: str) -> tuple[tuple[str, Row], ...]:
    """Domain and row of all causes of a table, those of other tables where it takes them.

    Args:
        domain: One of ``domains()``.

    Raises:
        ValueError: no such domain, or a table with mistakes.
    """
    if domain not in domains():
        raise ValueError(
            f"no causes of {domain!r}{did_you_mean(domain, domains())}; "
            f"known: {', '.join(domains())}"
        )
    path = _path_of(domain)
    found, wrong = list[tuple[str, Row]](), []
    for name, given in read_yaml_file(path).items():
        try:
            if "include" in given:
                found += _list_included(given)
            else:
                found.append((domain, Row.model_validate({"name": name, **given})))
        except ValidationError as error:
            wrong += problem_lines(f"{path.name}: {name}", error)
    if wrong:
        raise Mistakes(wrong)
    return tuple(found)


def _list_included(given: Mapping[str, Any]) -> list[tuple[str, Row]]:
    """Rows of another table, with what is said of them otherwise."""
    table, _, one = given["include"].partition("/")
    own = {key: value for key, value in given.items() if key != "include"}
    return [
        (of, Row.model_validate({**row.model_dump(), **own}) if own else row)
        for of, row in rows_in_order(table)
        if not one or row.name == one
    ]


def all_rows() -> Iterator[tuple[str, Row]]:
    """Domain and row of every cause, domain after domain."""
    for domain in domains():
        for row in rows(domain).values():
            yield domain, row
