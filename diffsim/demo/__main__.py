"""``python -m diffsim.demo``: the same as ``diffsim demo``."""

import sys

from diffsim.cli import main

if __name__ == "__main__":
    sys.exit(main(["demo", *sys.argv[1:]]))
