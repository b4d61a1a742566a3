"""The ``diffsim`` command, one file for each subcommand."""

from diffsim.cli.main import EXIT_INTERRUPTED, EXIT_MISTAKE, main

__all__ = ["EXIT_INTERRUPTED", "EXIT_MISTAKE", "main"]
