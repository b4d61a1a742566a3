"""A report of one HTML file: verdict first, then figures, tables, what was held fixed.

The page needs no network: styles, figures and, where it has charts, their script are inside.
"""

from __future__ import annotations

import platform
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from importlib import metadata, resources
from pathlib import Path
from typing import Any

from diffsim.core.files import write_text_atomic
from diffsim.core.optional import optional
from diffsim.core.version import __version__
from diffsim.viz import charts
from diffsim.viz.moving import Moving, MovingChoice, script

_NUMERIC = re.compile(
    r"[-+−–±<]? ?(\d|$)"
)  # a cell that starts with a number, or says there is none
TONES = ("good", "fair", "bad", "plain")


@dataclass(frozen=True, kw_only=True)
class Number:
    """One key figure: ``value`` with its unit, what it is, and how to read it."""

    label: str
    value: str
    unit: str = ""
    note: str = ""
    tone: str = "plain"

    def __post_init__(self) -> None:
        if self.tone not in TONES:
            raise ValueError(f"tone must be one of {TONES}, got {self.tone!r}")


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A figure. ``uri`` is a data URI, see ``figures.data_uri``; ``caption`` says what to see;
    ``narrow`` is the same drawn for a phone, where letters of the wide one cannot be read."""

    uri: str
    caption: str
    alt: str = ""
    narrow: str = ""


@dataclass(frozen=True, kw_only=True)
class Chart:
    """An interactive figure."""

    figure: Any  # figure of plotly
    caption: str  # what to see, and how to read it

    @property
    def html(self) -> str:
        """The figure without plotly's script."""
        return charts.to_html(self.figure)


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of finished strings; the first column is the row's name."""

    columns: Sequence[str]  # headings of the columns, with units
    rows: Sequence[Sequence[str]]  # cells, as many as columns
    caption: str = ""  # what the table shows
    emphasis: Sequence[int] = ()  # indices of rows to stress
    # indices of rows that stand in a part of their own, which a click opens
    folded: Sequence[int] = ()
    folded_words: str = ""  # what these rows are, as "refuted"

    def __post_init__(self) -> None:
        for i, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise ValueError(
                    f"table row {i} has {len(row)} cells, but there are {len(self.columns)} "
                    f"columns: {list(row)}"
                )

    @property
    def parts(self) -> list[tuple[str, list[int]]]:
        """Indices of rows by part, each with what a click opens it by; the first stands open."""
        folded = set(self.folded)
        parts = [("", [i for i in range(len(self.rows)) if i not in folded])]
        parts = parts if parts[0][1] or not folded else []
        if folded:
            is_counted = bool(parts)  # else the words say how many there are
            words = f"{len(folded)} {self.folded_words}" if is_counted else self.folded_words
            parts.append((words, sorted(folded)))
        return parts

    @property
    def numeric(self) -> frozenset[int]:
        """Columns of numbers, which stand to the right: all cells begin with one or say none."""
        return frozenset(
            i
            for i in range(1, len(self.columns))
            if any(re.search(r"\d", row[i]) for row in self.rows)
            and all(_NUMERIC.match(row[i]) for row in self.rows)
        )


Item = Picture | Chart | Moving | MovingChoice | Table


@dataclass(frozen=True, kw_only=True)
class Section:
    """A heading, a few sentences, then pictures, charts, views and tables in the order given."""

    title: str
    text: Sequence[str] = ()
    content: Sequence[Item] = ()


@dataclass(frozen=True, kw_only=True)
class Report:
    """Content of a page: title, key figures and sections.

    Attributes:
        title, subtitle: What was compared with what.
        verdict: The answer in a few sentences with numbers and units.
        banner: A warning across the page, such as "virtual data"; None for none.
        opening: Pictures between the answer and the key figures.
        numbers: Key figures, shown large.
        sections: Sections below the key figures.
        held_fixed: (what, value) pairs that were not fitted.
        versions: (what, version) pairs; by default those of the libraries that computed.
    """

    title: str
    subtitle: str
    verdict: Sequence[str]
    banner: str | None = None
    opening: Sequence[Item] = ()
    numbers: Sequence[Number] = ()
    sections: Sequence[Section] = ()
    held_fixed: Sequence[tuple[str, str]] = ()
    versions: Sequence[tuple[str, str]] = field(default_factory=lambda: versions())


def versions(
    packages: Sequence[str] = ("torch", "numpy", "scipy", "matplotlib"),
) -> list[tuple[str, str]]:
    """(name, version) of diffsim, Python, the machine and what computed the numbers."""
    installed = [("diffsim", __version__), ("Python", platform.python_version())]
    for package in packages:
        try:
            installed.append((package, metadata.version(package)))
        except metadata.PackageNotFoundError:
            installed.append((package, "not installed"))
    return [*installed, ("machine", f"{platform.system()} {platform.machine()}")]


def render(report: Report, *, made: datetime | None = None) -> str:
    """The page as text; everything that comes from outside is escaped."""
    jinja2 = optional("jinja2", purpose="an HTML report")
    folder = resources.files("diffsim.viz").joinpath("templates")
    source = folder.joinpath("report.html.j2").read_text("utf-8")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.tests["picture"] = lambda item: isinstance(item, Picture)
    environment.tests["chart"] = lambda item: isinstance(item, Chart)
    environment.tests["moving"] = lambda item: isinstance(item, (Moving, MovingChoice))
    kinds = {type(item) for section in report.sections for item in section.content}
    when = (made or datetime.now(timezone.utc)).strftime("%d %B %Y, %H:%M UTC")
    return environment.from_string(source).render(
        report=report,
        made=when,
        plotly=charts.packed_script() if Chart in kinds else "",
        charts=folder.joinpath("charts.js").read_text("utf-8") if Chart in kinds else "",
        views=script() if kinds & {Moving, MovingChoice} else "",
    )


def write(report: Report, path: str | Path) -> Path:
    """Render and write atomically."""
    return write_text_atomic(path, render(report))
