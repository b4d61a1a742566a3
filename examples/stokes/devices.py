"""How good do the other fluidic devices of thesis table 4.5 get, and what does a flow cost?

Random designs are drawn, the best one is improved by L-BFGS. Losses are normalized: 1 for an
average random design, 0 for a perfect device. The thesis gives neither coordinates nor bumps nor
target profiles, so that its losses compare problems of the same kind, not the same ones.

Expected, with seed 0 (amplifier: see ``amplifier.py``):

    options beside --out                                                  loss    thesis
    averager                                                              0.025   0.031
    gate                                                                  0.45    0.49
    funnel --evaluations 13                                               0.056   0.23
    twister --sample-resolution 0.5 --starts 1 --evaluations 7            0.0011  0.049
    switch --sample-resolution 0.375 --starts 1 --coarse-evaluations 16
        --evaluations 1 --checked 2                                       0.26    0.58

All losses are those of the thesis's grids; ``docs/measured/stokes.md`` has the table. Running
time in CPU minutes of one thread: averager and gate 1/2, funnel 6, twister 8, switch 12. With
--resolution 0.5 each takes one to three. --export adds a solid to print, VTK and rerun files.

    python examples/stokes/devices.py averager --out runs/averager
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import sys

from diffsim.cli import main

if __name__ == "__main__":
    with interruptible():
        sys.exit(main(["devices", *sys.argv[1:]]))
