"""The ``diffsim`` command, one file for each subcommand."""

from diffsim.cli.main import main

__all__ = ["main"]
