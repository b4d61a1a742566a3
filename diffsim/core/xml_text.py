"""XML of strangers has no document type, hence no entities that stand for more than they show."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

NO_DOCUMENT_TYPE = "a document type (<!DOCTYPE ...>) is not read; take it out"
_STEP = 65_536  # bytes


class _RootError(Exception):
    """The root element begins: no document type comes after it."""


def refuse_document_type(path: Path) -> None:
    """Refuse a file with a document type; what comes after its first element is not looked at.

    Raises:
        ValueError: it has one, or is no XML up to its first element; with the line.
    """
    parser = expat.ParserCreate()

    def refuse(*_: object) -> NoReturn:
        raise ValueError(f"{path.name}, line {parser.CurrentLineNumber}: {NO_DOCUMENT_TYPE}")

    def end(*_: object) -> NoReturn:
        raise _RootError

    parser.StartDoctypeDeclHandler, parser.StartElementHandler = refuse, end
    try:
        with path.open("rb") as file:
            while content := file.read(_STEP):
                parser.Parse(content)
    except _RootError:
        return
    except expat.ExpatError as error:
        why = expat.ErrorString(error.code)
        raise ValueError(f"{path.name}, line {error.lineno}: not XML: {why}") from None
