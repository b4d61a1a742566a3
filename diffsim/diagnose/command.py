"""``diffsim diagnose check|fit|explain|extend|next STUDY.yaml``."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from diffsim.errors import DiffsimError


class NotConnectedError(DiffsimError):
    """A step of the command that this version cannot do yet; nothing was done."""


def diagnose_command(args: argparse.Namespace) -> None:
    """Run one step.

    Raises:
        FileNotFoundError: no such study.
        NotConnectedError: the step is not connected yet.
    """
    if not args.study.is_file():
        raise FileNotFoundError(
            f"STUDY must be a YAML file of a study, got {args.study}, which does not exist"
        )
    step = CONNECTED.get(args.step)
    if step is None:
        raise NotConnectedError(
            f"diffsim diagnose {args.step} is not connected to the command line yet; nothing was "
            "read or written. Use diffsim.diagnose from Python"
        )
    step(args)


CONNECTED: dict[str, Callable[[argparse.Namespace], None]] = {}
"""Steps that work, by name."""
