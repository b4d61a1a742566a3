"""The ``diffsim`` command, one file for each subcommand."""

from diffsim.core.interrupts import EXIT_INTERRUPTED, ending_in_one_line

with ending_in_one_line():  # modules take a second to load
    from diffsim.cli.main import EXIT_MISTAKE, main

__all__ = ["EXIT_INTERRUPTED", "EXIT_MISTAKE", "main"]
