"""``python -m examples.demo``: the same as ``diffsim demo``."""

import sys

from diffsim.cli import main

sys.exit(main(["demo", *sys.argv[1:]]))
