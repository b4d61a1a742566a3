"""Argument types and defaults that several files share."""

from __future__ import annotations

import argparse

DIAGNOSES = "runs/diagnose"  # folder of the results, one folder per study


def positive(text: str) -> int:
    """Parse a whole number from 1."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be 1 or more, got {value}")
    return value


def names(text: str) -> tuple[str, ...]:
    """Names parted by commas; blanks do not count."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def fact(text: str) -> tuple[str, str]:
    """Name and value of ``name=value``."""
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise argparse.ArgumentTypeError(f"must be name=value, got {text!r}")
    return name.strip(), value.strip()
