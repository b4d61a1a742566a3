"""Texts of users' files with {words} in them, filled in: ``toss_{toss:03d}``, ``{:.2g} N lost``.

Python's own format would follow attributes, and write a number as wide as a file asks for.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

_FIELD = re.compile(r"\{\{|\}\}|\{([^{}:!]*)(?::([^{}]*))?\}|[{}]")
_FORMAT = re.compile(r"(?:.?[<>=^])?[-+ ]?0?\d{0,2},?(?:\.\d{1,2})?[a-zA-Z%]?")


def fill_in(text: str, words: Mapping[str, Any]) -> str:
    """A text with its {words} filled in; {{ and }} stand for braces.

    Args:
        text: ``{name}``, or ``{name:03d}`` with a format of at most two digits of width, and of
            places.
        words: What names stand for; "" is what ``{}`` stands for.

    Raises:
        KeyError: a name that there is not; its first argument is the name.
        ValueError: a format that is none, or wider; or a brace without its other one.
    """

    def word(found: re.Match[str]) -> str:
        if found[0] in ("{{", "}}"):
            return found[0][0]
        if found[1] is None:
            raise ValueError(f"{found[0]!r} at column {found.start() + 1} stands alone")
        stated = found[2] or ""
        if not _FORMAT.fullmatch(stated):
            raise ValueError(
                f"{stated[:20]!r} is no format of up to two digits, such as 03d or .2f"
            )
        return format(words[found[1].strip()], stated)

    return _FIELD.sub(word, text)
